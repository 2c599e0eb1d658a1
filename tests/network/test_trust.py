"""What SECURITY.md says of the network: who is heard, who may speak, and what is taken of it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.app import node
from sylpose.app.node_view import _pose_of
from sylpose.network.keys import LISTENER, access_rules, make_keys, tls_settings
from sylpose.network.zenoh_transport import LONGEST_LINE, Links, Place, check_name, line_of

NAMES = ("cam_0", "cam_1")
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda parts: st.lists(parts, max_size=4) | st.dictionaries(st.text(max_size=3), parts, max_size=3),
    max_leaves=8,
)


def test_a_node_listens_on_its_own_machine_unless_told_otherwise() -> None:
    assert Links().listen.rpartition(":")[0] == "127.0.0.1"
    assert Links().keys is None


def test_with_keys_everybody_speaks_under_its_own_name_alone() -> None:
    rules = access_rules(NAMES)
    assert rules["enabled"] is True
    assert rules["default_permission"] == "deny"
    given_to = {subject: set(policy["rules"]) for policy in rules["policies"] for subject in policy["subjects"]}
    heard = {rule["id"]: rule for rule in rules["rules"] if {"put", "delete"} & set(rule["messages"])}
    named = {subject["id"]: subject.get("cert_common_names") for subject in rules["subjects"]}
    for subject, its in given_to.items():
        speaks = [heard[rule] for rule in its if rule in heard and "ingress" in heard[rule]["flows"]]
        names = named[subject]
        assert [rule["key_exprs"] for rule in speaks] == ([[f"sylpose/*/*/*/{names[0]}/**"]] if names else [])
    assert {names[0] for names in named.values() if names} == set(NAMES)
    assert LISTENER not in NAMES


@pytest.mark.skipif(os.name != "posix", reason="no such rights")
def test_keys_are_their_owners_and_the_authoritys_is_not_used(tmp_path: Path) -> None:
    make_keys(tmp_path, NAMES)
    for file in tmp_path.glob("*.key"):
        assert file.stat().st_mode & 0o077 == 0, file
    settings = tls_settings(tmp_path, "cam_0")
    assert settings["enable_mtls"] is True
    assert not [value for value in settings.values() if str(value).endswith("ca.key")]


@pytest.mark.parametrize("name", ["", "a/b", "*", "**", "a b", "$x", "x" * 65, "a\n"])
def test_names_that_would_be_other_keys_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="a name of letters"):
        check_name("node", name)
    with pytest.raises(ValueError, match="a name of letters"):
        Place(name, "0", "lab")


@given(st.binary(max_size=50))
def test_lines_are_text(said: bytes) -> None:
    line = line_of(said)
    assert line is None or line.encode() == said


def test_long_lines_are_not_read() -> None:
    assert line_of(b" " * LONGEST_LINE) is not None
    assert line_of(b" " * (LONGEST_LINE + 1)) is None


@given(anything, anything, anything, anything)
def test_poses_of_strangers_are_poses_or_nothing(frame: object, time: object, place: object, turn: object) -> None:
    said = json.dumps({"frame": frame, "time": time, "position": place, "quaternion": turn})
    assert _pose_of(said) is None or isinstance(frame, (int, float, str))


@pytest.mark.parametrize("wrong", ["NaN", "Infinity", "1e300"])
def test_poses_that_are_not_finite_are_none(wrong: str) -> None:
    said = '{"frame": 3, "time": 0.1, "position": [0, 0, 1], "quaternion": [0, 0, 0, 1]}'
    assert _pose_of(said) is not None
    assert _pose_of(said.replace("[0, 0, 1]", f"[0, {wrong}, 1]")) is None
    assert _pose_of(said.replace("0.1", wrong)) is None
    assert _pose_of("[" * 10**5) is None


def test_what_strangers_say_steers_no_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = dict.fromkeys(("clock", "frames", "rate", "latency_ms", "bytes_per_frame", "rounds_per_frame"), 1.0)
    hostile = {**numbers, "state": "\x1b[2Jwell\r\n" + 1000 * "!", "members": ["\x1b]0;a\x07", "\u202eb"]}

    def watched(_: Links, __: str, on_state: Any, ___: Any) -> Any:
        for line in (json.dumps(hostile), "[" * 10**5, "{}", "null", json.dumps({**numbers, "frames": "many"})):
            on_state("0" * 16, "cam_0", line)
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(node, "watch_network", watched)
    assert node.nodes_aloud("lab", Links(), 0.0)
    said = capsys.readouterr().out
    assert "well" in said
    assert not {"\x1b", "\x07", "\r", "\u202e"} & set(said)
