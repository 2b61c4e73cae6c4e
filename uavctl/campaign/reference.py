"""The reference page of a campaign's keys, made from the types; `make docs` writes it."""

from __future__ import annotations

from uavctl.campaign.spec import CampaignSpec
from uavctl.campaign.trial_spec import TrialSpec
from uavctl.config.reference import tables

_HEAD = """# Keys of a campaign

This page is generated from the types in `uavctl/campaign/spec.py` and `trial_spec.py` (`make docs`); do not edit it.

A campaign is a TOML file; `docs/campaigns/` has complete ones, and [campaigns.md](campaigns.md) says how to fly and
read them. Every `set` is a list of overrides of the flight configuration, as `--set` takes them
([configuration.md](configuration.md)).
"""
_FLIGHTS = """# Keys of a campaign of flights

With `world = "quadrotor"` a campaign flies the true vehicle, and its file has these keys instead.
"""


def campaign_page() -> str:
    """The whole page, as Markdown."""
    return "\n".join((_HEAD, *tables(CampaignSpec, ""), _FLIGHTS, *tables(TrialSpec, "")))
