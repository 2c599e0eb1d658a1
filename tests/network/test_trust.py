"""Network guarantees of SECURITY.md: accepted senders, access rules and untrusted data."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.commands.node import NodesOptions, _parse_pose, nodes
from sylpose.network.keys import OBSERVER, build_access_rules, build_tls_settings, make_keys
from sylpose.network.zenoh_transport import MAX_LINE_BYTES, LinkSettings, NodeAddress, check_name, decode_line

NAMES = ("cam_0", "cam_1")
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda parts: st.lists(parts, max_size=4) | st.dictionaries(st.text(max_size=3), parts, max_size=3),
    max_leaves=8,
)


def test_node_listens_on_loopback_by_default() -> None:
    assert LinkSettings().listen.rpartition(":")[0] == "127.0.0.1"
    assert LinkSettings().keys is None


def test_keys_restrict_senders_to_own_name() -> None:
    rules = build_access_rules(NAMES)
    assert rules["enabled"] is True
    assert rules["default_permission"] == "deny"
    given_to = {subject: set(policy["rules"]) for policy in rules["policies"] for subject in policy["subjects"]}
    received = {rule["id"]: rule for rule in rules["rules"] if {"put", "delete"} & set(rule["messages"])}
    named = {subject["id"]: subject.get("cert_common_names") for subject in rules["subjects"]}
    for subject, its in given_to.items():
        speaks = [received[rule] for rule in its if rule in received and "ingress" in received[rule]["flows"]]
        names = named[subject]
        assert [rule["key_exprs"] for rule in speaks] == ([[f"sylpose/*/*/*/{names[0]}/**"]] if names else [])
    assert {names[0] for names in named.values() if names} == set(NAMES)
    assert OBSERVER not in NAMES


@pytest.mark.skipif(os.name != "posix", reason="no such rights")
def test_key_permissions_and_unused_authority_key(tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="the extra `network`")
    make_keys(tmp_path, NAMES)
    for file in tmp_path.glob("*.key"):
        assert file.stat().st_mode & 0o077 == 0, file
    settings = build_tls_settings(tmp_path, "cam_0")
    assert settings["enable_mtls"] is True
    assert not [value for value in settings.values() if str(value).endswith("ca.key")]


@pytest.mark.parametrize("name", ["", "a/b", "*", "**", "a b", "$x", "x" * 65, "a\n"])
def test_names_unsafe_in_keys_are_rejected(name: str) -> None:
    with pytest.raises(ValueError, match="a name of letters"):
        check_name("node", name)
    with pytest.raises(ValueError, match="a name of letters"):
        NodeAddress(name, "0", "lab")


@given(st.binary(max_size=50))
def test_published_lines_are_text(said: bytes) -> None:
    line = decode_line(said)
    assert line is None or line.encode() == said


def test_long_lines_are_rejected() -> None:
    assert decode_line(b" " * MAX_LINE_BYTES) is not None
    assert decode_line(b" " * (MAX_LINE_BYTES + 1)) is None


@given(anything, anything, anything, anything)
def test_untrusted_poses_are_valid_or_none(frame: object, time: object, place: object, turn: object) -> None:
    message = json.dumps({"frame": frame, "time": time, "position": place, "quaternion": turn})
    assert _parse_pose(message) is None or isinstance(frame, (int, float, str))


@pytest.mark.parametrize("wrong", ["NaN", "Infinity", "1e300"])
def test_non_finite_poses_are_rejected(wrong: str) -> None:
    message = '{"frame": 3, "time": 0.1, "position": [0, 0, 1], "quaternion": [0, 0, 0, 1]}'
    assert _parse_pose(message) is not None
    assert _parse_pose(message.replace("[0, 0, 1]", f"[0, {wrong}, 1]")) is None
    assert _parse_pose(message.replace("0.1", wrong)) is None
    assert _parse_pose("[" * 10**5) is None


def test_untrusted_text_is_sanitized_for_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("zenoh", reason="the extra `network`")
    numbers = dict.fromkeys(("clock", "frames", "rate", "latency_ms", "bytes_per_frame", "rounds_per_frame"), 1.0)
    hostile = {**numbers, "state": "\x1b[2Jwell\r\n" + 1000 * "!", "members": ["\x1b]0;a\x07", "\u202eb"]}

    def watched(_: LinkSettings, __: str, on_state: Any, ___: Any) -> Any:
        for line in (json.dumps(hostile), "[" * 10**5, "{}", "null", json.dumps({**numbers, "frames": "many"})):
            on_state("0" * 16, "cam_0", line)
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr("sylpose.network.zenoh_transport.watch_network", watched)
    nodes(NodesOptions(network="lab", seconds=0.1))
    message = capsys.readouterr().out
    assert "well" in message
    assert not {"\x1b", "\x07", "\r", "\u202e"} & set(message)
