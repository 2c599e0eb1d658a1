"""Archive guarantees of SECURITY.md: malicious file names and claim contents."""

from __future__ import annotations

from pathlib import Path

import pytest

from sylpose.archive.claims import read_current_claim
from sylpose.archive.contract import DONE_FILE, read_record
from sylpose.archive.stores import Store, StoredFile, open_store
from sylpose.archive.worker import _fetch


@pytest.mark.parametrize("name", ["../outside.mp4", "cam_0/../../outside.png", "/outside.mp4"])
def test_copies_stay_in_scratch_folder(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "scratch"
    target.mkdir()
    monkeypatch.setattr(Store, "files", lambda _: [StoredFile(name, 3, "")])
    monkeypatch.setattr(Store, "fetch", lambda _, __, there: there.write_bytes(b"out"))
    with pytest.raises(ValueError, match="outside"):
        _fetch("memory://archive", target)
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == []


@pytest.mark.parametrize("name", ["claim-x.json", "claim-.json", "claim-\u00b2.json", f"claim-{'9' * 100}.json"])
def test_invalid_claim_names_are_ignored(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"{}")
    assert read_current_claim(open_store(tmp_path)) is None


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b'{"digest": 3}', b"\x80\x04", b"null", b"[" * 10**5])
def test_invalid_records_are_processed_again(content: bytes, tmp_path: Path) -> None:
    (tmp_path / DONE_FILE).write_bytes(content)
    assert read_record(open_store(tmp_path)) is None
