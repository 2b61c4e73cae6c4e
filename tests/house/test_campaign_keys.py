"""docs/campaign-keys.md: the campaign that it begins with is read as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

from docs import campaign_page
from uavctl.lab.campaign.spec import read_campaign


def test_the_campaign_of_the_page_is_read(tmp_path: Path) -> None:
    (block,) = re.findall(r"^```toml\n(.*?)^```$", campaign_page(), re.MULTILINE | re.DOTALL)
    path = tmp_path / "mine.toml"
    path.write_text(block, encoding="utf-8")
    campaign, _ = read_campaign(path)
    assert [one.kind for one in campaign.spec.controller] == ["smpc"]
