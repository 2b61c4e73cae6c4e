"""`[security]`: what is refused, what is warned of, and that a key never gets into a dumped configuration."""

from __future__ import annotations

import pytest

from uavctl.config import load_config
from uavctl.config.connections import SecurityConfig, find_security_warnings
from uavctl.config.load import dump_config
from uavctl.errors import ConfigError

UDP = ("daemon.vehicle=udpin://0.0.0.0:14540", "daemon.mocap=udpin://0.0.0.0:14560")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("security.key_file=keys/vehicle.key", 'security.key_file: "keys/vehicle.key" depends on where'),
        ('security.allow=["192.0.2.1", "vehicle.local"]', r'security.allow\[1\]: "vehicle.local" is no address'),
        ('security.allow=["192.0.2.0/33"]', r"security.allow\[0\]"),
        ('security.allow="192.0.2.1"', "security.allow: expected"),
        ("security.require=[]", "security.require"),
        ('security.require=["camera"]', "security.require"),
        ("security.link_id=255", "security.link_id"),
        ("security.peer_link_ids=[256]", "security.peer_link_ids"),
        ("security.max_datagrams_per_s=10", "security.max_datagrams_per_s"),
        ("security.keyfile=00", 'unknown key .nearest valid name "key_file"'),
    ],
)
@pytest.mark.fault(33)
def test_what_cannot_be_is_refused(override: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_config("room-hahn-stursberg", (override,))


def test_the_presets_ask_for_nothing() -> None:
    assert load_config("room-hahn-stursberg").security == SecurityConfig()


def test_a_dumped_configuration_comes_back() -> None:
    given = ('security.allow=["192.0.2.0/24", "2001:db8::1"]', "security.key_file=~/vehicle.key", "security.link_id=3")
    config = load_config("room-hahn-stursberg", given)
    assert config.security.allow == ("192.0.2.0/24", "2001:db8::1")
    assert 'key_file = "~/vehicle.key"' in dump_config(config)


@pytest.mark.fault(39)
@pytest.mark.parametrize(
    ("overrides", "wanted"),
    [
        (UDP, ["vehicle,mocap any", "vehicle,mocap signed"]),
        ((*UDP, 'security.allow=["192.0.2.1"]'), ["vehicle,mocap signed"]),
        ((*UDP, "security.key_file=/k"), ["vehicle,mocap any"]),
        ((*UDP, "security.key_file=/k", 'security.require=["vehicle"]'), ["vehicle,mocap any", "mocap signed"]),
        ((*UDP, "security.key_file=/k", 'security.allow=["192.0.2.1"]'), []),
        ((UDP[0], "daemon.mocap=udpin://0.0.0.0:14540"), ["vehicle any", "vehicle signed"]),
        (("daemon.vehicle=udpout://192.0.2.1:1", "daemon.mocap=serial:///dev/x:1"), ["vehicle signed"]),
        (("daemon.vehicle=tcp://192.0.2.1:1", "daemon.mocap=serial:///dev/x:1"), []),
    ],
)
def test_what_is_open_to_strangers_is_warned_of(overrides: tuple[str, ...], wanted: list[str]) -> None:
    config = load_config("room-hahn-stursberg", overrides)
    found = find_security_warnings(config.security, config.daemon)
    assert len(found) == len(wanted)
    for text, words in zip(found, wanted, strict=True):
        names, kind = words.split()
        assert text.startswith(f"{', '.join(names.split(','))}: ")
        assert ("security.allow" if kind == "any" else "security.key_file") in text
