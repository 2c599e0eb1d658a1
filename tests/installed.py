"""Check that the result of `make dist` is complete and works without a checkout: `python -m tests.installed DIST`.

The wheels and the sdist are installed into separate environments in a temporary folder. The wheels render and track a
short recording. The one for this platform (`tests/kernel_wheel.py`) compiles nothing for that.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import tempfile
import venv
from pathlib import Path
from zipfile import ZipFile

from sylpose import __version__
from sylpose.geometry.kernel_cache import CACHE_DIR_VARIABLE, SHIPPED_FOLDER
from tests.paths import REPOSITORY

PACKAGE = REPOSITORY / "src" / "sylpose"
KERNELS = f"sylpose/{SHIPPED_FOLDER.name}/"
# Next to the package: project and license files.
LEGAL = [name for name in ("LICENSE", "NOTICE") if (REPOSITORY / name).exists()]
DEMO = ["demo", "--frames", "6", "--turn", "9", "--cameras", "3"]
REFINED = ["track", "sylpose_demo", "--refine-calibration", "--out", "again"]
FIRST_MOTION = """
import time
import numpy as np
from scipy.spatial.transform import Rotation
from sylpose import Matches, estimate_motion
from sylpose.simulate import ring
rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
turn = Rotation.from_rotvec([0.05, -0.03, 0.08])
seen = [[c.normalize(c.project(r.apply(points))) for r in (Rotation.identity(), turn)] for c in rig]
start = time.process_time()
estimate_motion(rig, [Matches(x, y) for x, y in seen])
print(f"the first motion takes {time.process_time() - start:.2f} s of processor time")
"""


def package_files() -> set[str]:
    """Return all files that belong in a wheel, by their path in it."""
    files = (path for path in PACKAGE.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {f"sylpose/{path.relative_to(PACKAGE).as_posix()}" for path in files}


def wheel_contents(wheel: Path) -> list[str]:
    """Return the problems of the files in a wheel, one sentence each."""
    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
    info = f"sylpose-{__version__}.dist-info/"
    of_package = {name for name in names if not name.startswith((info, KERNELS))}
    wrong = [
        f"{wheel.name} has {name}, which is no part of the package" for name in sorted(of_package - package_files())
    ]
    wrong += [f"{wheel.name} lacks {name}" for name in sorted(package_files() - of_package)]
    wrong += [f"{wheel.name} lacks {name}" for name in LEGAL if f"{info}licenses/{name}" not in names]
    if ("-cp" in wheel.name) != any(name.startswith(KERNELS) for name in names):
        wrong += [f"{wheel.name} has compiled kernels although it is for all platforms, or lacks them"]
    return wrong


def sdist_contents(sdist: Path) -> list[str]:
    """Return the same for a source distribution, which packagers use; it includes tests and documents."""
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {f"src/{name}" for name in package_files()} | {*LEGAL, "README.md", "CITATION.cff", "pyproject.toml"}
    wanted |= {"tests/installed.py", "docs/map.md"}
    wrong = [f"{sdist.name} lacks {name}" for name in sorted(wanted - names)]
    return wrong + [
        f"{sdist.name} has {name}" for name in sorted(names) if name.startswith((".venv", "demo/", "dist/"))
    ]


def run_isolated(folder: Path, *command: str | Path) -> str:
    """Return the output of a command in a folder, isolated from this checkout."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, env=kept, stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{' '.join(str(word) for word in command)}: exit code {done.returncode}\n{done.stdout}")
    return done.stdout


def try_out(built: Path, folder: Path, commands: list[list[str]]) -> None:
    """Install a wheel or sdist into an environment in a folder and run some commands there."""
    venv.create(folder / "environment", with_pip=True)
    programs = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
    python, sylpose = programs / "python", programs / "sylpose"
    run_isolated(folder, python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", built.resolve())
    where = run_isolated(
        folder, python, "-c", "import sylpose; print(sylpose.__file__, *map(str, (sylpose.track, sylpose.Rig)))"
    )
    assert Path(where.split()[0]).is_relative_to(folder / "environment"), where
    assert run_isolated(folder, sylpose, "--version") == f"sylpose {__version__}\n"
    assert "track" in run_isolated(folder, sylpose, "--help")
    assert json.loads(run_isolated(folder, sylpose, "doctor", "--json"))["problems"] == []
    if commands:
        print(run_isolated(folder, python, "-c", FIRST_MOTION))
    for command in commands:
        print(run_isolated(folder, sylpose, *command))


def main(built: Path) -> None:
    (anywhere,), (here,) = built.glob("sylpose-*-any.whl"), built.glob("sylpose-*-cp*.whl")
    (sdist,) = built.glob("sylpose-*.tar.gz")
    if wrong := [*wheel_contents(anywhere), *wheel_contents(here), *sdist_contents(sdist)]:
        sys.exit("\n".join(wrong))
    for file, commands in ((sdist, []), (anywhere, [DEMO]), (here, [DEMO, REFINED])):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name).resolve()
            os.environ[CACHE_DIR_VARIABLE] = str(folder / "compiled")
            try_out(file, folder, commands)
            if file == here and (compiled := sorted((folder / "compiled").rglob("*.nbc"))):
                sys.exit(
                    f"{here.name}: compiled {len(compiled)} kernels that it should contain: {compiled[0].name}, ..."
                )
        print(f"{file.name}: whole, and works")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
