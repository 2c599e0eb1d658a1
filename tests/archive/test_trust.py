"""Archive guarantees of SECURITY.md: malicious file names and claim contents."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from sylpose.archive.contract import DONE_FILE, hold_claim, process_recording, read_record
from sylpose.archive.worker import _fetch
from sylpose.io.stores import ObjectStore, StoredFile, open_store
from tests.archive.archive_worker import count_work, make_recordings, make_settings, read_owner


@pytest.mark.parametrize("name", ["../outside.mp4", "cam_0/../../outside.png", "/outside.mp4"])
def test_copies_stay_in_scratch_folder(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("obstore", reason="the extra `archive`")
    target = tmp_path / "scratch"
    target.mkdir()
    monkeypatch.setattr(ObjectStore, "files", lambda _: [StoredFile(name, 3, "", 0.0)])
    monkeypatch.setattr(ObjectStore, "fetch", lambda _, __, there: there.write_bytes(b"out"))
    with pytest.raises(ValueError, match="outside"):
        _fetch("memory://archive", target)
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == []


@pytest.mark.parametrize("name", ["claim-x", "claim-", "claim-\u00b2", f"claim-{'9' * 100}", "claim-000001.json"])
def test_invalid_claim_names_are_ignored(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"{}")
    store = open_store(tmp_path)
    assert read_owner(store) == ""
    with hold_claim(store, "a"):
        assert (tmp_path / "claim-000000").exists()
    assert [file.name for file in store.files()] == [name]


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b'{"digest": 3}', b"\x80\x04", b"null", b"[" * 10**5])
def test_invalid_records_are_processed_again(content: bytes, tmp_path: Path) -> None:
    (tmp_path / DONE_FILE).write_bytes(content)
    assert read_record(open_store(tmp_path)) is None


@pytest.mark.parametrize("name", ["../outside.txt", "/outside.txt", "a/../../outside.txt"])
def test_forged_record_removes_no_file_outside(name: str, tmp_path: Path) -> None:
    (one,) = make_recordings(tmp_path / "in", one="work")
    settings = make_settings(open_store(tmp_path / "out"))
    process_recording(one, settings)
    outside = tmp_path / "out" / "outside.txt"
    outside.touch()
    record = read_record(settings.destination.join("one"))
    assert record is not None
    forged = msgspec.structs.replace(record, files=(name if name[0] != "/" else str(outside),), digest="")
    (tmp_path / "out" / "one" / DONE_FILE).write_bytes(msgspec.json.encode(forged))
    assert process_recording(one, settings).status == "done"
    assert count_work(tmp_path / "in", "one") == 2
    assert outside.exists()
