"""Cache folders: writable, and not writable by others."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest

from sylpose.geometry import kernel_cache
from sylpose.geometry.kernel_cache import display_folder, find_cache_folders

PERMISSIONS = pytest.mark.skipif(not hasattr(os, "getuid"), reason="Windows: folders below the user's are the user's")


@pytest.fixture
def source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a source file with a writable folder, a user's cache and a temporary folder; clear the function caches."""
    for name in ("_find_cache_folders", "_is_private", "is_writable"):
        getattr(kernel_cache, name).cache_clear()
    for name in ("package", "caches", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(kernel_cache, "_user_cache_folder", lambda: tmp_path / "caches")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "package" / "kernels.py").touch()
    return tmp_path / "package" / "kernels.py"


def unwritable(folder: Path) -> None:
    """Make a path unwritable, even for root, by creating a file there."""
    folder.touch()


def test_folder_next_to_sources_is_first(source: Path) -> None:
    beside = source.parent / "__pycache__"
    assert find_cache_folders(source) == ((beside,), beside)
    assert display_folder(beside) == Path(kernel_cache.__file__).parents[1]
    assert not list((source.parents[1] / "caches").iterdir()), "what is not needed is not made"


def test_first_writable_and_previous_folders_are_searched(source: Path) -> None:
    beside = source.parent / "__pycache__"
    unwritable(beside)
    (first, users), kept_in = find_cache_folders(source)
    assert (first, kept_in) == (beside, users)
    assert display_folder(users) == source.parents[1] / "caches" / "sylpose"
    assert users.name.startswith("package_")


def test_installations_have_separate_folders(source: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "package" / "kernels.py"
    other.parent.mkdir(parents=True)
    for each in (source, other):
        unwritable(each.parent / "__pycache__")
    one, another = find_cache_folders(source)[1], find_cache_folders(other)[1]
    assert one is not None
    assert another is not None
    assert one != another
    assert one.parent == another.parent


def test_temporary_folder_then_none(source: Path, tmp_path: Path) -> None:
    unwritable(source.parent / "__pycache__")
    unwritable(tmp_path / "caches" / "sylpose")
    kept_in = find_cache_folders(source)[1]
    assert kept_in is not None
    assert kept_in.is_relative_to(tmp_path / "temporary")
    if hasattr(os, "getuid"):
        assert kept_in.parent.stat().st_mode & 0o777 == 0o700
    for name in ("_find_cache_folders", "_is_private", "is_writable"):
        getattr(kernel_cache, name).cache_clear()
    for folder in (kept_in, kept_in.parent):
        folder.rmdir()
    unwritable(kept_in.parent)
    assert find_cache_folders(source) == ((source.parent / "__pycache__",), None)


def test_working_directory_is_not_a_temporary_folder(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python returns it if there is no other."""
    unwritable(source.parent / "__pycache__")
    unwritable(tmp_path / "caches" / "sylpose")
    monkeypatch.chdir(tmp_path / "temporary")
    assert find_cache_folders(source)[1] is None
    assert not list((tmp_path / "temporary").iterdir())


@PERMISSIONS
@pytest.mark.parametrize("how", ["others may write", "a link", "another user's"])
def test_folders_writable_by_others_are_rejected(
    source: Path, tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An attacker can create the folder first."""
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
    assert find_cache_folders(source) == ((source.parent / "__pycache__",), None)


def test_user_set_folder_is_first(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    (only,), kept_in = find_cache_folders(source)
    assert only == kept_in
    assert display_folder(only) == tmp_path / "chosen"


def test_read_only_user_set_folder_is_searched(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unwritable(tmp_path / "chosen")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    (chosen, beside), kept_in = find_cache_folders(source)
    assert display_folder(chosen) == tmp_path / "chosen"
    assert kept_in == beside == source.parent / "__pycache__"


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="they have other folders")
def test_missing_home_does_not_create_tilde_folder(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as without HOME and without such a user
    monkeypatch.chdir(tmp_path)
    assert kernel_cache._user_cache_folder() is None
    unwritable(source.parent / "__pycache__")
    find_cache_folders(source)
    assert not (tmp_path / "~").exists()
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert kernel_cache._user_cache_folder() == Path("/somewhere")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert kernel_cache._user_cache_folder() is None
