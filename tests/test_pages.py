"""Documentation site: every page is in the navigation, every link is valid, every public name is described."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from urllib.parse import unquote

import pytest

import sylpose
from pages import api, build, gallery
from tests.paths import REPOSITORY

# Largest size of a gallery picture, bytes.
MOST = 150_000


@pytest.fixture(scope="module")
def staged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("staged") / "pages"
    folder.mkdir()
    build.stage(folder)
    return folder


def prose(page: Path) -> str:
    return re.sub(r"(?ms)^ *```.*?^ *```$", "", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in re.findall(r"(?m)^#+ (.*)$", prose(page))}


def test_every_page_is_listed_once() -> None:
    placed = [page for _, pages in build.navigation() for page in pages]
    assert len(placed) == len(set(placed))
    folder = REPOSITORY / "docs"
    docs = {path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.md")}
    notebooks = {f"notebooks/{path.stem}" for path in (REPOSITORY / "examples" / "notebooks").glob("*.ipynb")}
    assert docs | notebooks | {"api", "contributing", "changelog"} <= set(placed)
    assert "index" not in placed


def test_unlisted_page_comes_last(monkeypatch: pytest.MonkeyPatch) -> None:
    known = build.sources()
    monkeypatch.setattr(build, "sources", lambda: {**known, "new": REPOSITORY / "docs" / "new.md"})
    title, pages = build.navigation()[-1]
    assert (title, pages[-1]) == ("More", "new")


def test_duplicate_page_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "nav.toml").write_text('[[section]]\ntitle = "A"\npages = ["live", "sync", "live"]\n')
    monkeypatch.setattr(build, "NAV", tmp_path / "nav.toml")
    with pytest.raises(ValueError, match=r"nav\.toml: live twice"):
        build.navigation()


def test_staged_links_exist(staged: Path) -> None:
    count = 0
    for page in staged.rglob("*.md"):
        for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
            if "://" in target:
                continue
            file, _, anchor = unquote(target).partition("#")
            goal = (page.parent / file).resolve() if file else page
            assert goal.is_file(), f"{page.name}: {target}"
            assert goal.is_relative_to(staged), f"{page.name}: {target}"
            if anchor:
                assert anchor in anchors(goal), f"{page.name}: {target}"
            count += 1
    assert count > 150
    assert (staged / "files" / "examples" / "listen.py").is_file()


def test_broken_link_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = REPOSITORY / "docs" / "live.md"
    for target in ("nowhere.md", "../../../etc/hostname"):
        monkeypatch.setattr(
            Path, "read_text", lambda self, t=target, **_: f"[x]({t})" if self == page else "", raising=True
        )
        monkeypatch.setattr(build, "sources", lambda: {"live": page})
        with pytest.raises(ValueError, match=rf"live\.md: a link to {re.escape(target)}, which is not there"):
            build.stage(tmp_path / target.replace("/", "_"))


# --- the API ---------------------------------------------------------------------------------------------------------


def entry(name: str) -> str:
    """Return the page's text on one name."""
    return re.split(r"(?m)^##+ ", api.markdown().partition(f"\n### {name}\n")[2], maxsplit=1)[0]


def test_every_public_name_is_in_one_group() -> None:
    names = [name for group in api.GROUPS.values() for name in group]
    assert sorted(names) == sorted(sylpose.__all__)


@pytest.mark.parametrize("name", sylpose.__all__)
def test_every_public_name_is_described(name: str) -> None:
    text, thing = entry(name), getattr(sylpose, name)
    first = (inspect.getdoc(thing) or "").splitlines()[0]
    assert first
    assert first in re.sub(r"\[(`\w+`)\]\(#\w+\)", r"\1", text)
    assert text.count("```") % 2 == 0
    if inspect.isfunction(thing):
        assert f"```python\n{name}(" in text
        described = {word for names in re.findall(r"(?m)^- `([\w, ]+)`:", text) for word in names.split(", ")}
        parameters = {p for p in inspect.signature(thing).parameters if not p.startswith("_")}
        # Other parameters are described by reference to another function, or in the first sentences.
        assert all(p in described or re.search(rf"\b{p}\b", text.split("```")[-1]) for p in parameters), parameters


def test_arguments_are_a_list_and_names_are_links() -> None:
    text = entry("estimate_motion")
    assert re.search(r"(?m)^- `noise_px`: \(C,\) standard deviation of a keypoint", text)
    assert "[`Motion`](#motion)" in text
    assert "method: str = 'epipolar'" in text
    assert "*Raises*" in text
    assert '- `OK`, "ok": The estimate converged and every requested quantity is observable.' in entry("Status")
    assert "[`RotationEstimate`](#rotationestimate)" in entry("CentralizedSolution")
    assert "_boxes" not in entry("Session")


# --- the gallery -----------------------------------------------------------------------------------------------------


def test_gallery_is_up_to_date() -> None:
    results = gallery.results()
    assert (REPOSITORY / "docs" / "gallery.md").read_text(encoding="utf-8") == gallery.page(results)
    for name, text in results.items():
        assert re.search(r"\d+ of \d+ frames with a pose, off by 0\.\d\d° in the median", text), name
        picture = REPOSITORY / "docs" / "images" / f"gallery_{name}.jpg"
        assert 20_000 < picture.stat().st_size < MOST


@pytest.mark.parametrize("name", gallery.SCENES)
def test_gallery_scenes_can_be_made(name: str) -> None:
    shown = gallery.SCENES[name]
    recording = shown.recording()
    assert 0 <= shown.frame < recording.frames
    assert all(camera.size[0] % 64 == 0 for camera in recording.scene.rig)
    if shown.calibration is not None:
        assert shown.calibration(recording.scene.rig).names == recording.scene.rig.names


# --- the site --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_site_builds_and_dead_links_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sphinx")
    pytest.importorskip("furo")
    build.build(tmp_path / "site")
    pages = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html")}
    assert {f"{page}.html" for page in build.sources()} <= pages
    assert "estimate_motion" in (tmp_path / "site" / "api.html").read_text(encoding="utf-8")
    markdown = api.markdown
    monkeypatch.setattr(api, "markdown", lambda: markdown() + "\n[x](#no-such-section)\n")
    with pytest.raises(RuntimeError, match="could not be made"):
        build.build(tmp_path / "site")
    assert (tmp_path / "site" / "index.html").exists()
