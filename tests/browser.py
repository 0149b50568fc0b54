"""Pages in a headless browser, for the tests of reports."""

import json
import re
import subprocess


def browse(chromium, path, profile, width):
    """What DRIVER found on the page, and the lines of the console."""
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
        f"--window-size={width},1600",
        "--virtual-time-budget=20000",
        "--enable-logging=stderr",
        "--dump-dom",
        path.as_uri(),
    ]
    result = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    found = re.search(r'<pre id="found">(.*?)</pre>', result.stdout, re.S)
    assert found, result.stderr[-2000:]
    return json.loads(found[1]), [line for line in result.stderr.splitlines() if "CONSOLE" in line]
