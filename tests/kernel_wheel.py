"""Make a wheel with compiled kernels of the wheel in a folder: `python -m tests.kernel_wheel DIST`.

It is for the platform and Python version that it is made on. Who installs it compiles nothing, if their Numba has the
version that it was made with. With another one, kernels are compiled when they are first called, as from the other wheel.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.tags import sys_tags

from sylpose.geometry.kernel_cache import CACHE_DIR_VARIABLE, PACKAGE, PORTABLE_CPU, SHIPPED_FOLDER, find_cache_folders

# What a first day calls: everything that `tests.compile_kernels` does, all kinds of two frames, and recordings.
SYLPOSE = ["-c", "from sylpose.commands.main import main; main()"]
COMMANDS = [
    ["-m", "tests.compile_kernels"],
    ["-c", "from benchmarks import honesty as h; [h.evaluate_scenes(k, range(1)) for k in [*h.MOTIONS, *h.POSES]]"],
    [*SYLPOSE, "doctor"],
    [*SYLPOSE, "demo", "--frames", "24", "--turn", "60", "--out", "demo"],
    [*SYLPOSE, "track", "demo", "--refine-calibration", "--every", "2", "--out", "again", "--no-overlay"],
]


def compile_portable(folder: Path) -> None:
    """Compile the kernels for any processor into a cache folder."""
    settings = {"NUMBA_CPU_NAME": PORTABLE_CPU, "NUMBA_CPU_FEATURES": "", CACHE_DIR_VARIABLE: str(folder)}
    here = {"PYTHONPATH": os.pathsep.join([str(PACKAGE.parent), os.getcwd()])}
    for command in COMMANDS:
        subprocess.run([sys.executable, *command], check=True, cwd=folder, env=os.environ | settings | here)


def copy_kernels(cached: Path, target: Path) -> int:
    """Copy the kernels of all subpackages from a cache folder; return their size in bytes."""
    os.environ[CACHE_DIR_VARIABLE] = str(cached)
    size = 0
    for source in sorted(PACKAGE.rglob("*.py")):
        (first, *_), _ = find_cache_folders(source)
        for file in first.glob(f"{source.stem}.*.nb[ci]"):
            to = target / source.parent.relative_to(PACKAGE) / file.name
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, to)
            size += to.stat().st_size
    return size


def find_tag() -> str:
    """Return the tag of wheels for this Python and platform; kernels need nothing of the C library that is new."""
    tags = [tag for tag in sys_tags() if not tag.platform.startswith("linux")]
    return str(next((tag for tag in tags if tag.platform.startswith("manylinux_2_17")), tags[0]))


def main(built: Path) -> None:
    (wheel,) = built.glob("sylpose-*-py3-none-any.whl")
    tool = [sys.executable, "-m", "wheel"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        compile_portable(folder)
        subprocess.run([*tool, "unpack", "--dest", folder / "wheel", wheel], check=True)
        (unpacked,) = (folder / "wheel").iterdir()
        size = copy_kernels(folder, unpacked / "sylpose" / SHIPPED_FOLDER.name)
        subprocess.run([*tool, "pack", "--dest-dir", folder, unpacked], check=True)
        python, abi, platform = find_tag().split("-")
        tags = ["--python-tag", python, "--abi-tag", abi, "--platform-tag", platform]
        subprocess.run([*tool, "tags", "--remove", *tags, folder / wheel.name], check=True)
        (made,) = folder.glob("sylpose-*.whl")
        shutil.move(made, built / made.name)
    print(f"{made.name}: kernels of {size / 1e6:.0f} MB, {(built / made.name).stat().st_size / 1e6:.1f} MB zipped")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
