"""Where compiled code may be kept: where it can be written, and where nobody else can."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest

from sylpose.geometry import cache_folders
from sylpose.geometry.cache_folders import folders_of, place_of

PERMISSIONS = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows: folders below the user's are the user's")


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A source file whose folder can be written, a user's cache and a temporary folder, and nothing known of them."""
    for name in ("_folders", "_is_ours", "is_writable"):
        getattr(cache_folders, name).cache_clear()
    for name in ("package", "caches", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(cache_folders, "_caches", lambda: tmp_path / "caches")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "package" / "kernels.py").touch()
    return tmp_path / "package" / "kernels.py"


def unwritable(folder: Path) -> None:
    """Nobody, not even root, makes files in a file."""
    folder.touch()


def test_beside_the_sources_if_that_can_be(source: Path) -> None:
    beside = source.parent / "__pycache__"
    assert folders_of(source) == ((beside,), beside)
    assert place_of(beside) == Path(cache_folders.__file__).parents[1]
    assert not list((source.parents[1] / "caches").iterdir()), "what is not needed is not made"


def test_the_next_that_can_be_written_and_all_before_it_are_looked_in(source: Path) -> None:
    beside = source.parent / "__pycache__"
    unwritable(beside)
    (first, users), kept_in = folders_of(source)
    assert (first, kept_in) == (beside, users)
    assert place_of(users) == source.parents[1] / "caches" / "sylpose"
    assert users.name.startswith("package_")


def test_of_two_installations_each_has_its_own(source: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "package" / "kernels.py"
    other.parent.mkdir(parents=True)
    for each in (source, other):
        unwritable(each.parent / "__pycache__")
    one, another = folders_of(source)[1], folders_of(other)[1]
    assert one is not None
    assert another is not None
    assert one != another
    assert one.parent == another.parent


def test_then_the_temporary_folder_and_then_none(source: Path, tmp_path: Path) -> None:
    unwritable(source.parent / "__pycache__")
    unwritable(tmp_path / "caches" / "sylpose")
    kept_in = folders_of(source)[1]
    assert kept_in is not None
    assert kept_in.is_relative_to(tmp_path / "temporary")
    if hasattr(os, "getuid"):
        assert kept_in.parent.stat().st_mode & 0o777 == 0o700
    for name in ("_folders", "_is_ours", "is_writable"):
        getattr(cache_folders, name).cache_clear()
    for folder in (kept_in, kept_in.parent):
        folder.rmdir()
    unwritable(kept_in.parent)
    assert folders_of(source) == ((source.parent / "__pycache__",), None)


def test_the_working_directory_is_no_temporary_folder(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python says it is where there is no other."""
    unwritable(source.parent / "__pycache__")
    unwritable(tmp_path / "caches" / "sylpose")
    monkeypatch.chdir(tmp_path / "temporary")
    assert folders_of(source)[1] is None
    assert not list((tmp_path / "temporary").iterdir())


@PERMISSIONS
@pytest.mark.parametrize("how", ["others may write", "a link", "another user's"])
def test_no_code_is_loaded_from_where_others_can_write(
    source: Path, tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who knows where it will be can be there first."""
    unwritable(source.parent / "__pycache__")
    unwritable(tmp_path / "caches" / "sylpose")
    base = tmp_path / "temporary" / f"sylpose-{os.getuid()}"
    if how == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        base.symlink_to(tmp_path / "elsewhere")
    else:
        base.mkdir()
        base.chmod(0o777 if how == "others may write" else 0o700)
    if how == "another user's":
        uid = os.getuid()
        monkeypatch.setattr(os, "getuid", lambda: uid + 1)
        base.rename(base.with_name(f"sylpose-{uid + 1}"))
    assert folders_of(source) == ((source.parent / "__pycache__",), None)


def test_what_the_user_names_comes_first(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    (only,), kept_in = folders_of(source)
    assert only == kept_in
    assert place_of(only) == tmp_path / "chosen"


def test_what_the_user_names_and_cannot_be_written_is_looked_in(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unwritable(tmp_path / "chosen")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    (chosen, beside), kept_in = folders_of(source)
    assert place_of(chosen) == tmp_path / "chosen"
    assert kept_in == beside == source.parent / "__pycache__"


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="they have other folders")
def test_who_has_no_home_has_no_folder_called_tilde(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as where there is neither HOME nor such a user
    monkeypatch.chdir(tmp_path)
    assert cache_folders._caches() is None
    unwritable(source.parent / "__pycache__")
    folders_of(source)
    assert not (tmp_path / "~").exists()
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert cache_folders._caches() == Path("/somewhere")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folders._caches() is None
