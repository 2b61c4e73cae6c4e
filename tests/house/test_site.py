"""The site of the manual has every page of docs/ once in its navigation; `make test-all` builds it."""

from __future__ import annotations

import re

from places import ROOT


def test_every_page_is_once_in_the_navigation() -> None:
    _, _, navigation = (ROOT / "tools" / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")
    pages = re.findall(r"^ +- (?:[^:\n]+: )?(\S+\.md)$", navigation, re.MULTILINE)
    assert sorted(pages) == sorted(page.name for page in (ROOT / "docs").glob("*.md"))
