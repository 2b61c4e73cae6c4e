"""Every link of the documentation leads somewhere, and every page is reachable from docs/index.md."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
from places import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
LINK = re.compile(r"(?<!\\)\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def find_links(page: Path) -> list[str]:
    return [link for link in LINK.findall(CODE.sub("", page.read_text(encoding="utf-8"))) if "://" not in link]


@cache
def find_anchors(page: Path) -> frozenset[str]:
    """The anchors that a page's headings make, as GitHub and most renderers do."""
    text = CODE.sub(lambda code: code[0].strip("`") if "\n" not in code[0] else "", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return frozenset(re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for link in find_links(page):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor and target.suffix == ".md":
            assert anchor in find_anchors(target), link


def test_every_page_is_reachable_from_the_index() -> None:
    index = ROOT / "docs" / "index.md"
    reached, todo = {index}, [index]
    while todo:
        page = todo.pop()
        result = {(page.parent / link.partition("#")[0]).resolve() for link in find_links(page)}
        new = {path for path in result if path.suffix == ".md" and path.exists()} - reached
        reached |= new
        todo += new
    assert {page.name for page in (ROOT / "docs").glob("*.md")} <= {page.name for page in reached}


def test_a_link_to_nowhere_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A `name` of it\n\n[x](#a-name-of-it) [y](none.md) `[z](code.md)`\n")
    assert find_links(page) == ["#a-name-of-it", "none.md"]
    assert find_anchors(page) == {"a-name-of-it"}
