"""The documentation site is built without warnings, and its pages request no other server."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlsplit

import pytest

ROOT = Path(__file__).parents[1]
FETCHED = {
    "audio": "src", "embed": "src", "iframe": "src", "image": "href", "img": "src", "input": "src",
    "object": "data", "script": "src", "source": "src", "track": "src", "use": "href",
    "video": "src",
}  # fmt: skip
"""Elements that a browser fetches, with the attribute that names what; `link` depends on `rel`."""
FETCHED_LINKS = {"dns-prefetch", "icon", "manifest", "modulepreload", "preconnect", "prefetch",
                 "preload", "stylesheet"}  # fmt: skip


class Requests(HTMLParser):
    """Collects the addresses that a browser fetches when it shows a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        if tag in FETCHED and (address := values.get(FETCHED[tag])):
            self.found.append(address)
        if tag == "link" and FETCHED_LINKS & set(values.get("rel", "").split()):
            self.found.append(values["href"])
        self.found += re.findall(r"url\(['\"]?([^'\")]+)", values.get("style", ""))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site. Warnings are errors: broken links and anchors, pages that are not listed."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def _is_outside(address: str) -> bool:
    parts = urlsplit(address)
    return bool(parts.netloc) or parts.scheme not in ("", "data")


def test_pages_fetch_nothing_from_outside(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 50
    for page in pages:
        requests = Requests()
        requests.feed(page.read_text())
        assert [each for each in requests.found if _is_outside(each)] == [], page.name
    for sheet in [*site.rglob("*.css"), *site.rglob("*.svg")]:
        text = sheet.read_text()
        addresses = re.findall(r"(?:url\(|@import\s+)['\"]?([^'\")]+)", text)
        assert [each for each in addresses if _is_outside(each)] == [], sheet.name


def test_the_reference_has_the_public_names_and_no_private_ones(site: Path) -> None:
    """Every name of `asp_env.__all__` but the deprecated `load` has an anchor of its own."""
    import asp_env

    anchors = {
        anchor
        for page in (site / "api").glob("*.html")
        for anchor in re.findall(r'id="(asp_env\.[\w.]+)"', page.read_text())
    }
    named = {anchor.rsplit(".", 1)[-1] for anchor in anchors}
    assert {*asp_env.__all__} - {"load"} <= named
    assert [anchor for anchor in anchors if re.search(r"\._[a-z]", anchor)] == []
