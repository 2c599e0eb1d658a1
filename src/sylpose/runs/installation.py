"""Check of the installation and list of missing optional packages (`sylpose doctor`).

Modules that may be broken are imported one by one in the checks, never at the top of this file.
"""

from __future__ import annotations

import os
import platform
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distributions, requires, version
from pathlib import Path
from types import ModuleType

from packaging.requirements import Requirement

import sylpose
from sylpose.runs.system_resources import available_cores, available_memory

# Module names of distributions whose module is named differently.
MODULE_NAMES = {"opencv-python-headless": "cv2", "pillow": "PIL", "pyyaml": "yaml", "eclipse-zenoh": "zenoh"}
# All of these install the module cv2 into the same folder.
OPENCV_PACKAGES = {f"opencv{contrib}-python{end}" for contrib in ("", "-contrib") for end in ("", "-headless")}
# Extras for developers of sylpose.
DEVELOPER_EXTRAS = {"dev", "bench"}


@dataclass
class Diagnosis:
    """Result of checking the installation.

    Attributes:
        facts: text of each fact by its label.
        versions: versions of sylpose, Python, OpenCV's packages and all required modules, by name.
        problems: messages about requirements that do not work.
        warnings: messages about possible problems.
        extras: missing requirements by name of the extra; empty if the extra is complete.
    """

    facts: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    extras: dict[str, list[str]] = field(default_factory=dict)


def diagnose() -> Diagnosis:
    """Run all checks; report each failure as a message instead of an exception."""
    found = Diagnosis(versions={"sylpose": sylpose.__version__, "Python": platform.python_version()})
    found.facts["sylpose"] = f"{sylpose.__version__} in {Path(sylpose.__file__).parent}"
    found.facts["Python"] = f"{platform.python_version()} ({platform.python_implementation()}), {sys.executable}"
    found.facts["Platform"] = f"{platform.platform()}, {platform.machine()}"
    memory = available_memory()
    memory_text = "" if memory is None else f", {memory / 2**30:.0f} GB of memory"
    found.facts["Computer"] = f"{available_cores()} cores{memory_text}"
    modules = dict(_import_libraries(found))
    found.facts["Libraries"] = ", ".join(f"{name} {found.versions[name]}" for name in modules)
    if opencv := modules.get("cv2"):
        _check_opencv(opencv, found)
    checks = {
        "cv2": ("SIFT features cannot be detected", _can_detect_features),
        "av": ("videos cannot be decoded", lambda av: "h264" in av.codecs_available),
    }
    for name, (message, works) in checks.items():
        if module := modules.get(name):
            try:
                if not works(module):
                    found.problems.append(f"{message} by {name} {getattr(module, '__version__', '')}")
            except Exception as error:
                found.problems.append(f"{message} by {name} ({type(error).__name__}: {error})")
    _check_folders(found)
    if not found.problems:
        _check_kernels(found)
    _check_extras(found)
    return found


def _list_requirements() -> list[tuple[Requirement, str]]:
    """Return sylpose's requirements, each with the name of its extra or ""."""
    try:
        lines = requires("sylpose") or []
    except PackageNotFoundError:
        return []
    found = []
    for line in lines:
        requirement = Requirement(line)
        match = re.search(r"extra == ['\"]([\w-]+)['\"]", str(requirement.marker or ""))
        found.append((requirement, match.group(1) if match else ""))
    return found


def _module_name(name: str) -> str:
    return MODULE_NAMES.get(name.lower(), name.lower().replace("-", "_"))


def _import_libraries(found: Diagnosis) -> Iterator[tuple[str, ModuleType]]:
    """Import the required modules; yield name and module of each that can be loaded."""
    needed = [requirement for requirement, extra in _list_requirements() if not extra]
    if not needed:
        found.warnings.append("sylpose is run from its sources, not installed; its requirements are not checked")
    for requirement in needed:
        name, needs = _module_name(requirement.name), f"{requirement.name}{requirement.specifier}"
        try:
            module = import_module(name)
        except Exception as error:  # incompatible libraries may raise anything
            remedy = f"python -m pip install '{needs}'"
            if name == "cv2" and "libGL" in str(error):
                remedy = "opencv-python-headless needs no graphics: uninstall the other package and install it"
            found.problems.append(f"{name} cannot be loaded ({type(error).__name__}: {error}); {remedy}")
            continue
        installed = getattr(module, "__version__", None) or _installed_version(requirement.name)
        found.versions[name] = str(installed or "?")
        if installed and not requirement.specifier.contains(str(installed), prereleases=True):
            found.problems.append(f"{name} is {installed}, sylpose needs {needs}: python -m pip install '{needs}'")
        yield name, module


def _installed_version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _check_opencv(cv2: ModuleType, found: Diagnosis) -> None:
    """Report the installed OpenCV packages; several at once overwrite each other's files."""
    names = {(d.metadata["Name"] or "").lower().replace("_", "-") for d in distributions()}
    installed = sorted(names & OPENCV_PACKAGES)
    found.versions |= {name: _installed_version(name) or "?" for name in installed}
    gui = re.search(r"(?m)^\s*GUI:\s*(\S+)", cv2.getBuildInformation())
    windows = "with GUI" if gui and gui.group(1) != "NONE" else "without GUI"
    packages = " and ".join(f"{name} {_installed_version(name)}" for name in installed) or "not from a pip package"
    found.facts["OpenCV"] = f"{cv2.__version__}: {packages}; {windows}, in {Path(cv2.__file__ or '').parent}"
    if len(installed) > 1:
        found.warnings.append(
            f"{len(installed)} packages of OpenCV are installed into one folder, {' and '.join(installed)}: they "
            "overwrite each other's files. Uninstall them all and install one"
        )


def _can_detect_features(cv2: ModuleType) -> bool:
    import numpy as np

    noise = np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8)
    return len(cv2.SIFT_create().detect(cv2.resize(noise, (256, 256)))) > 0


def _check_folders(found: Diagnosis) -> None:
    try:
        found.facts["Temporary"] = tempfile.gettempdir()
    except OSError:
        found.warnings.append("no temporary folder is writable: set TMPDIR=FOLDER; batch and plots need it")


def _check_kernels(found: Diagnosis) -> None:
    """Report where compiled code is cached, and check that compiled code runs."""
    try:
        from sylpose.geometry.kernel_cache import (
            CACHE_DIR_VARIABLE,
            describe_compilation,
            display_folder,
            is_writable,
            mark_announced,
        )
        from sylpose.runs.precompile import find_kernel_cache, is_compiled
    except Exception as error:
        found.problems.append(f"sylpose itself cannot be loaded ({type(error).__name__}: {error})")
        return
    chosen = os.environ.get(CACHE_DIR_VARIABLE)
    if chosen and not is_writable(Path(chosen)):
        found.warnings.append(f"{CACHE_DIR_VARIABLE}={chosen} cannot be written; compiled code is cached elsewhere")
    mark_announced()  # suppress the notice: the fact below reports the same
    folder, is_ready = find_kernel_cache(), is_compiled()
    where = "" if folder is None else f", cached in {display_folder(folder)}"
    found.facts["Compiled code"] = f"{'ready' if is_ready else 'not compiled yet'}{where}"
    if folder is None and not is_ready:
        found.warnings.append(f"kernels are compiled for one to two minutes {describe_compilation(folder)}")
    try:
        import numpy as np

        from sylpose.geometry.numba_linalg import cholesky_solve

        x = np.array([2.0, 4.0])
        if not cholesky_solve(2.0 * np.eye(2), x) or not np.allclose(x, [1.0, 2.0]):
            raise ArithmeticError(f"2 x = (2, 4) gave x = {x}")
    except Exception as error:
        found.problems.append(f"Numba cannot compile or run compiled code ({type(error).__name__}: {error})")


def _check_extras(found: Diagnosis) -> None:
    for requirement, extra in _list_requirements():
        if extra and extra not in DEVELOPER_EXTRAS and requirement.name.lower() != "sylpose":
            missing = found.extras.setdefault(extra, [])
            installed = _installed_version(requirement.name)
            if installed is None or not requirement.specifier.contains(installed, prereleases=True):
                missing.append(f"{requirement.name}{requirement.specifier}")
