"""README and the site: short, without broken links, with commands that the parser knows, and without a warning."""

import ast
import os
import re
import shlex
import subprocess
import sys
import tomllib

import pytest
from pages import PAGES, ROOT, blocks, command_lines, documents

from btfref.cli import build_parser
from btfref.provenance import __version__
from btfref.registry import methods

COMMANDS = sorted(
    {(path.relative_to(ROOT).as_posix(), line) for path in documents() for line in command_lines(path)}
)


def test_pages_show_commands():
    """Rationale: the next test says nothing about commands that are not found. Expected: README and pages have them."""
    assert len([line for where, line in COMMANDS if where == "README.md"]) >= 5
    assert len(COMMANDS) > 60
    assert len({where for where, _ in COMMANDS}) > 15


@pytest.mark.parametrize(("where", "line"), COMMANDS)
def test_commands_are_understood(where, line):
    assert callable(build_parser().parse_args(shlex.split(line, comments=True)[1:]).run)


@pytest.mark.parametrize("path", documents(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_python_blocks_parse(path):
    for block in blocks(path):
        if block.language == "python":
            ast.parse(block.text)


def test_readme_is_short():
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 150
    assert len(text.split()) <= 1100


def test_readme_and_guide_list_all_methods():
    own = {key for key, row in methods().items() if not row.shader_package}
    for path in (ROOT / "README.md", PAGES / "guide" / "compress.md"):
        assert set(re.findall(r"^\| `(\w+)` \|", path.read_text("utf-8"), re.MULTILINE)) == own


def anchors(path):
    """The anchors of a page's headings, as MkDocs makes them."""
    lines = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\s-]", "", line).strip().lower().replace(" ", "-") for line in lines}


@pytest.mark.parametrize("path", [*documents(), ROOT / "CHANGELOG.md"], ids=lambda path: path.name)
def test_links_resolve(path):
    text = re.sub(r"^```.*?^```$", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?:", target):
            continue
        name, _, anchor = target.partition("#")
        file = path.parent / name if name else path
        assert file.exists(), f"{path.name} links to {target}"
        if anchor:
            assert anchor in anchors(file), f"{path.name} links to {target}"


def test_the_layout_shows_every_floor():
    source = (ROOT / "tests" / "unit" / "test_floors.py").read_text("utf-8")
    (floors,) = re.findall(r'^FLOORS = """\n(.*?)"""', source, re.MULTILINE | re.DOTALL)
    shown = re.findall(r"`([\w.]+)`", (PAGES / "reference" / "layout.md").read_text("utf-8"))
    assert set(floors.split()) - {"btfref.__main__", "btfref.docs"} <= set(shown)


def test_versions_agree():
    changelog = (ROOT / "CHANGELOG.md").read_text("utf-8")
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\] – (\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE)
    sections = re.findall(r"^## (.*)$", changelog, re.MULTILINE)
    assert len(released) == len(sections) - (sections[0] == "[Unreleased]")
    assert released == sorted(released, key=lambda r: [int(n) for n in r[0].split(".")], reverse=True)
    assert released[0][0] == __version__
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.findall(r"^version: (\S+)$", citation, re.MULTILINE) == [__version__]
    assert re.findall(r'^date-released: "(\S+)"$', citation, re.MULTILINE) == [released[0][1]]


def test_the_citation_is_complete():
    """What version 1.2.0 of the format requires, and what is not empty of the rest."""
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    keys = re.findall(r"^([a-z-]+):", text, re.MULTILINE)
    assert {"cff-version", "message", "title", "authors"} <= set(keys)
    assert len(keys) == len(set(keys))
    assert "cff-version: 1.2.0" in text
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert f"license: {project['license']}" in text
    assert f"  - name: {project['authors'][0]['name']}" in text


def test_the_hosted_check_runs_the_script():
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8")
    assert "run: .ci/run" in text
    assert {"push:", "pull_request:"} <= set(text.split())


def build(folder, config):
    """Build the site strictly; returns what MkDocs said and its status."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder / "site")]
    done = subprocess.run(
        [*command, "--config-file", str(config)],
        cwd=folder,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    return done.stdout + done.stderr, done.returncode


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, and what was said while it was built."""
    folder = tmp_path_factory.mktemp("docs")
    said, status = build(folder, PAGES.parent / "mkdocs.yml")
    assert status == 0, said
    return folder / "site", said


def test_the_site_is_built_without_a_warning(site):
    folder, said = site
    assert "WARNING" not in said
    assert "ERROR" not in said
    pages = [path for path in folder.rglob("*.html") if path.name != "404.html"]
    assert len(pages) == len(list(PAGES.rglob("*.md")))


def test_a_broken_link_stops_the_build(tmp_path):
    """Rationale: a build that never fails proves nothing. Expected: it names the page and the link."""
    (tmp_path / "pages").mkdir()
    (tmp_path / "pages" / "index.md").write_text("# x\n\n[nowhere](nowhere.md)\n")
    config = (PAGES.parent / "mkdocs.yml").read_text("utf-8")
    short = config[: config.index("markdown_extensions:")].replace("extra_css: [assets/site.css]", "")
    (tmp_path / "mkdocs.yml").write_text(short)
    said, status = build(tmp_path, tmp_path / "mkdocs.yml")
    assert status != 0
    assert "nowhere.md" in said


def test_the_site_loads_nothing_from_elsewhere(site):
    """Scripts, styles, fonts and pictures are its own; links for people may lead elsewhere."""
    folder, _ = site
    for path in folder.rglob("*.html"):
        text = path.read_text("utf-8")
        assert re.findall(r"<(?:script|img|iframe)[^>]+src=\"?https?:[^\s>]*", text) == []
        assert (
            re.findall(r"<link[^>]+rel=\"?(?:stylesheet|preconnect)\"?[^>]+href=\"?https?:[^\s>]*", text)
            == []
        )


def test_the_reference_shows_docstrings(site):
    folder, _ = site
    text = (folder / "api" / "index.html").read_text("utf-8")
    assert "btfref.fit" in text
    assert "Compress a sampled BTF" in text


def test_roles_of_docstrings_are_plain_code(site):
    folder, _ = site
    for path in (folder / "api").glob("*.html"):
        assert re.findall(r":(?:class|func|meth|mod|data|attr):<code>", path.read_text("utf-8")) == []
