"""What SECURITY.md says of archives: names of files and contents of claims that others made up."""

from __future__ import annotations

from pathlib import Path

import pytest

from sylpose.archive.claims import holder
from sylpose.archive.contract import DONE, read_record
from sylpose.archive.stores import File, Place, place
from sylpose.archive.worker import _fetched


@pytest.mark.parametrize("name", ["../outside.mp4", "cam_0/../../outside.png", "/outside.mp4"])
def test_nothing_is_copied_out_of_the_scratch_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "scratch"
    target.mkdir()
    monkeypatch.setattr(Place, "files", lambda _: [File(name, 3, "")])
    monkeypatch.setattr(Place, "fetch", lambda _, __, there: there.write_bytes(b"out"))
    with pytest.raises(ValueError, match="outside"):
        _fetched("memory://archive", target)
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == []


@pytest.mark.parametrize("name", ["claim-x.json", "claim-.json", "claim-\u00b2.json", f"claim-{'9' * 100}.json"])
def test_names_that_are_no_claims_are_nobodys(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"{}")
    assert holder(place(tmp_path)) is None


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b'{"digest": 3}', b"\x80\x04", b"null", b"[" * 10**5])
def test_records_that_are_none_are_done_again(content: bytes, tmp_path: Path) -> None:
    (tmp_path / DONE).write_bytes(content)
    assert read_record(place(tmp_path)) is None
