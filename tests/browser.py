"""Pages in a headless browser, for the tests of reports."""

import html
import json
import re
import subprocess

#: A page in a frame of a given width: a window itself is never narrower than 500 pixels. What a driver at the end of
#: the page tells ``parent`` is put down where `--dump-dom` prints it.
FRAME = """<!doctype html><iframe src="{uri}" style="width:{width}px;height:1600px;border:0"></iframe>
<script>
addEventListener("message", (event) => {{
  const out = document.createElement("pre");
  out.id = "found"; out.textContent = event.data;
  document.body.append(out);
}});
</script>"""


def browse(chromium, path, profile, width):
    """What the page's driver sent with ``parent.postMessage(JSON.stringify(found), "*")``, and the console's lines."""
    frame = profile.with_name(f"{profile.name}.html")
    frame.write_text(FRAME.format(uri=path.as_uri(), width=width), "utf-8")
    command = [
        chromium,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--disable-dev-shm-usage",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        f"--user-data-dir={profile}",
        f"--window-size={width + 100},1700",
        "--virtual-time-budget=20000",
        "--enable-logging=stderr",
        "--dump-dom",
        frame.as_uri(),
    ]
    result = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    found = re.search(r'<pre id="found">(.*?)</pre>', result.stdout, re.S)
    assert found, result.stderr[-2000:]
    return json.loads(html.unescape(found[1])), [
        line for line in result.stderr.splitlines() if "CONSOLE" in line
    ]
