"""`sylpose doctor`: what is installed here, whether it works, and what is missing for what.

Loads what it looks at by and by, and nothing at its top that may be broken.
"""

from __future__ import annotations

import json
import os
import platform
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distributions, requires, version
from pathlib import Path
from types import ModuleType

from packaging.requirements import InvalidRequirement, Requirement

import sylpose
from sylpose.app.system_resources import cores, memory_of_machine
from sylpose.geometry.cache_folders import CHOSEN, is_writable, place_of

__all__ = ["Diagnosis", "diagnose", "doctor_aloud"]

# The module of a distribution, where it has another name.
MODULES = {"opencv-python-headless": "cv2", "pyyaml": "yaml", "eclipse-zenoh": "zenoh"}
# All of them are the one module cv2, in the same folder.
OPENCVS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless")
LABEL = 14
# Extras of those who work on sylpose.
NOT_FOR_USERS = {"dev", "bench"}


@dataclass
class Diagnosis:
    """What was found.

    Attributes:
        facts: what there is, in words, by what it is called.
        versions: of sylpose, Python, OpenCV's packages and all modules that are needed.
        problems: sentences about what is broken and needed.
        warnings: sentences about what may be.
        extras: by name: the requirements that are missing, none where it is all there.
    """

    facts: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    extras: dict[str, list[str]] = field(default_factory=dict)


def doctor_aloud(*, as_json: bool = False, compile_first: bool = False) -> list[str]:
    """Says what was found; the problems.

    Args:
        as_json: as one object, with the fields of `Diagnosis`.
        compile_first: compile what tracking needs, where that has not been done.
    """
    found = diagnose()
    if compile_first and not found.problems:
        from sylpose.app.console_output import make_console
        from sylpose.app.precompile import compile_aloud

        compile_aloud(make_console(stderr=as_json))
        found = diagnose()
    if as_json:
        print(json.dumps(asdict(found), indent=2))
        return found.problems
    for label, value in found.facts.items():
        print(f"{label:{LABEL}}{value}")
    for k, (name, missing) in enumerate(found.extras.items()):
        said = f"python -m pip install {' '.join(map(repr, missing))}" if missing else "there"
        print(f"{'' if k else 'Extras':{LABEL}}{name}: {said}")
    for warning in found.warnings:
        print(f"! {warning}")
    if not found.problems:
        print("What is needed works; see above." if found.warnings else "All that is needed works.")
    return found.problems


def diagnose() -> Diagnosis:
    """Looks at everything; what fails is a sentence and no exception."""
    found = Diagnosis(versions={"sylpose": sylpose.__version__, "Python": platform.python_version()})
    found.facts["sylpose"] = f"{sylpose.__version__} in {Path(sylpose.__file__).parent}"
    found.facts["Python"] = f"{platform.python_version()} ({platform.python_implementation()}), {sys.executable}"
    found.facts["Platform"] = f"{platform.platform()}, {platform.machine()}"
    memory = memory_of_machine()
    found.facts["Computer"] = f"{cores()} cores" + ("" if memory is None else f", {memory / 2**30:.0f} GB of memory")
    modules = dict(_libraries(found))
    found.facts["Libraries"] = ", ".join(f"{name} {found.versions[name]}" for name in modules)
    if opencv := modules.get("cv2"):
        _look_at_opencv(opencv, found)
    _try(found, "SIFT features cannot be found", modules.get("cv2"), _finds_features)
    _try(found, "videos cannot be decoded", modules.get("av"), _decodes)
    _look_at_folders(found)
    if not found.problems:
        _look_at_kernels(found)
    _look_at_extras(found)
    return found


def _requirements() -> list[tuple[Requirement, str]]:
    """What is required, with the extra that requires it, if any."""
    try:
        lines = requires("sylpose") or []
    except PackageNotFoundError:
        return []
    found = []
    for line in lines:
        try:
            requirement = Requirement(line)
        except InvalidRequirement:
            continue
        of = re.search(r"extra == ['\"]([\w-]+)['\"]", str(requirement.marker or ""))
        found.append((requirement, of.group(1) if of else ""))
    return found


def _module_of(name: str) -> str:
    return MODULES.get(name.lower(), name.lower().replace("-", "_"))


def _libraries(found: Diagnosis) -> Iterator[tuple[str, ModuleType]]:
    """Loads what is needed, by its module's name."""
    needed = [requirement for requirement, extra in _requirements() if not extra]
    if not needed:
        found.warnings.append("sylpose is not installed but run from its sources; what it needs is not looked at")
    for requirement in needed:
        name = _module_of(requirement.name)
        try:
            module = import_module(name)
        except Exception as error:  # of a library that does not fit another one, anything
            how = f"python -m pip install '{requirement.name}{requirement.specifier}'"
            if name == "cv2" and "libGL" in str(error):
                how = "opencv-python-headless needs no graphics: uninstall the other one and install that"
            found.problems.append(f"{name} cannot be loaded ({type(error).__name__}: {error}); {how}")
            continue
        there = getattr(module, "__version__", None) or _version(requirement.name)
        found.versions[name] = str(there or "?")
        if there and not requirement.specifier.contains(str(there), prereleases=True):
            found.problems.append(
                f"{name} is {there}, sylpose needs {requirement.name}{requirement.specifier}: "
                f"python -m pip install '{requirement.name}{requirement.specifier}'"
            )
        yield name, module


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _look_at_opencv(cv2: ModuleType, found: Diagnosis) -> None:
    """Which OpenCV it is: several at once overwrite each other's files."""
    there = sorted({name for name in (_name(d.metadata["Name"]) for d in distributions()) if name in OPENCVS})
    found.versions |= {name: _version(name) or "?" for name in there}
    gui = re.search(r"(?m)^\s*GUI:\s*(\S+)", cv2.getBuildInformation())
    windows = "with windows" if gui and gui.group(1) != "NONE" else "without windows"
    which = " and ".join(f"{name} {_version(name)}" for name in there) or "of no package of pip's"
    found.facts["OpenCV"] = f"{cv2.__version__}: {which}; {windows}, in {Path(cv2.__file__ or '').parent}"
    if len(there) > 1:
        found.warnings.append(
            f"{len(there)} packages of OpenCV are installed into one folder, {' and '.join(there)}: the one that was "
            "installed last counts, and taking one away breaks the other. Uninstall them all and install one"
        )


def _name(said: str | None) -> str:
    return (said or "").lower().replace("_", "-")


def _try(found: Diagnosis, failed: str, module: ModuleType | None, works: Callable[[ModuleType], bool]) -> None:
    if module is None:
        return
    try:
        if works(module):
            return
        found.problems.append(f"{failed} by {module.__name__} {getattr(module, '__version__', '')}")
    except Exception as error:
        found.problems.append(f"{failed} by {module.__name__} ({type(error).__name__}: {error})")


def _finds_features(cv2: ModuleType) -> bool:
    import numpy as np

    noise = np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8)
    return len(cv2.SIFT_create().detect(cv2.resize(noise, (256, 256)))) > 0


def _decodes(av: ModuleType) -> bool:
    return "h264" in av.codecs_available


def _look_at_folders(found: Diagnosis) -> None:
    try:
        found.facts["Temporary"] = tempfile.gettempdir()
    except OSError:
        found.warnings.append("no temporary folder can be written: TMPDIR=FOLDER names one; batch and plots need it")
    chosen = os.environ.get(CHOSEN)
    if chosen and not is_writable(Path(chosen)):
        found.warnings.append(f"{CHOSEN}={chosen} cannot be written; what is compiled is kept elsewhere")


def _look_at_kernels(found: Diagnosis) -> None:
    """Where compiled code is, and whether it runs."""
    try:
        from sylpose.app.precompile import is_compiled, kept_in
        from sylpose.geometry.kernel_cache import announced
    except Exception as error:
        found.problems.append(f"sylpose itself cannot be loaded ({type(error).__name__}: {error})")
        return
    announced()  # the line below says it
    folder, done = kept_in(), is_compiled()
    where = "nowhere: no folder can be written" if folder is None else f"in {place_of(folder)}"
    found.facts["Compiled code"] = f"{'there' if done else 'not there yet'}; what is compiled is kept {where}"
    if folder is None and not done:
        found.warnings.append(
            f"what is compiled can be kept nowhere, so that every start takes one to two minutes: {CHOSEN}=FOLDER names a "
            "folder for it"
        )
    try:
        _compiles()
    except Exception as error:
        found.problems.append(f"Numba cannot compile or run what it compiled ({type(error).__name__}: {error})")


def _compiles() -> None:
    import numpy as np

    from sylpose.geometry.numba_linalg import cholesky_solve

    x = np.array([2.0, 4.0])
    if not cholesky_solve(2.0 * np.eye(2), x) or not np.allclose(x, [1.0, 2.0]):
        raise ArithmeticError(f"2 x = (2, 4) came out as {x}")


def _look_at_extras(found: Diagnosis) -> None:
    for requirement, extra in _requirements():
        if extra and extra not in NOT_FOR_USERS and requirement.name.lower() != "sylpose":
            missing = found.extras.setdefault(extra, [])
            there = _version(requirement.name)
            if there is None or not requirement.specifier.contains(there, prereleases=True):
                missing.append(f"{requirement.name}{requirement.specifier}")
