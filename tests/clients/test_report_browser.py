"""The page in a real browser: nothing on its console, every figure drawn, nothing beyond the edge, no text on text."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

LIMIT_S = 60.0
NAMES = ("chromium", "chromium-browser", "google-chrome")
# Measures the page from inside and leaves the figures in its title. Texts of one figure must not lie on each other.
PROBE = """
<script>
const shown = [...document.querySelectorAll('figure')].filter(f => f.getBoundingClientRect().width > 0);
const on = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1.5
  && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1.5;
const clashes = [], cut = [];
for (const figure of shown) {
  const edge = figure.getBoundingClientRect();
  const texts = [...figure.querySelectorAll('svg text')].map(t => [t.textContent, t.getBoundingClientRect()]);
  texts.forEach(([name, box], i) => {
    if (box.left < edge.left - 1 || box.right > edge.right + 1) cut.push(figure.id + ': ' + name);
    for (const [other, at] of texts.slice(i + 1)) if (on(box, at)) clashes.push(figure.id + ': ' + name + '|' + other);
  });
}
document.title = JSON.stringify({
  wide: document.documentElement.scrollWidth, seen: document.documentElement.clientWidth,
  figures: shown.length, flat: shown.filter(f => f.getBoundingClientRect().height < 60).map(f => f.id), clashes, cut,
  background: getComputedStyle(document.body).backgroundColor,
});
</script>
"""


def browser() -> str:
    for name in NAMES:
        found = shutil.which(name)
        if found:
            return found
    pytest.fail(f"no browser: install one of {', '.join(NAMES)}")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    fly = ["loopback", "--duration", "14", "--set", "link.blackout=[[6, 8]]", "--out", str(folder), "--json"]
    subprocess.run([sys.executable, "-m", "uavctl", *fly], check=True, stdout=subprocess.DEVNULL, timeout=LIMIT_S)
    out = folder / "probed.html"
    text = (folder / "flight.html").read_text(encoding="utf-8")
    out.write_text(text.replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    return out


def open_page(page: Path, width: int, *options: str) -> tuple[dict[str, object], str]:
    """What the probe found, and what the page said on the console."""
    run = subprocess.run(
        [browser(), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={page.parent / str(width)}",
         "--enable-logging=stderr", "--dump-dom", f"--window-size={width},900", *options, page.as_uri()],
        capture_output=True, text=True, timeout=LIMIT_S, check=True,
    )  # fmt: skip
    title = re.search(r"<title>(.*?)</title>", run.stdout, re.DOTALL)
    assert title is not None
    found = json.loads(title.group(1).replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">"))
    return found, "\n".join(line for line in run.stderr.splitlines() if "CONSOLE" in line)


@pytest.mark.parametrize("width", [500, 800, 1400])
def test_the_page_is_whole_at_every_width(page: Path, width: int) -> None:
    found, console = open_page(page, width)
    assert console == ""
    assert found["wide"] == found["seen"]
    assert found["figures"] == 32
    assert (found["flat"], found["clashes"], found["cut"]) == ([], [], [])


def test_dark_pages_are_dark(page: Path) -> None:
    light, _ = open_page(page, 1000)
    dark, console = open_page(page, 1001, "--blink-settings=preferredColorScheme=0")
    assert console == ""
    assert (light["background"], dark["background"]) == ("rgb(243, 245, 247)", "rgb(18, 22, 27)")


def test_it_prints(page: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.pdf"
    subprocess.run(
        [browser(), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'user'}",
         f"--print-to-pdf={out}", page.as_uri()],
        capture_output=True, timeout=LIMIT_S, check=True,
    )  # fmt: skip
    assert out.read_bytes().startswith(b"%PDF")
    assert out.stat().st_size > 20_000
