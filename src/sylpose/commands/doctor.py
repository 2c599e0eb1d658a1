"""`sylpose doctor`: check the installation and list missing optional packages."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

from sylpose.commands.app import CommandOptions, command, exit_with_failures, option

LABEL_WIDTH = 14


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(CommandOptions):
    """Options of `sylpose doctor`.

    Attributes:
        json: Print one JSON object, for programs and bug reports.
        compile: Compile the tracking kernels now, to save the time in the first run.
    """

    json: Annotated[bool, option("--json")] = False
    compile: Annotated[bool, option("--compile")] = False


@command("Check the installation.")
def doctor(options: DoctorOptions) -> None:
    """Check the installation and list missing optional packages.

    Shows versions, the OpenCV variant, cores and memory, the cache of compiled code, and the extras with their install
    commands. Exits with code 1 and a message for each required package that is missing or broken.

    Examples:
        sylpose doctor
        sylpose doctor --json
        sylpose doctor --compile
    """
    import json

    from sylpose.runs.installation import diagnose

    found = diagnose()
    if options.compile and not found.problems:
        from sylpose.runs.console_output import make_console
        from sylpose.runs.precompile import compile_with_progress

        compile_with_progress(make_console(stderr=options.json))
        found = diagnose()
    if options.json:
        print(json.dumps(asdict(found), indent=2))
    else:
        for label, value in found.facts.items():
            print(f"{label:{LABEL_WIDTH}}{value}")
        for k, (name, missing) in enumerate(found.extras.items()):
            text = f"python -m pip install {' '.join(map(repr, missing))}" if missing else "installed"
            print(f"{'' if k else 'Extras':{LABEL_WIDTH}}{name}: {text}")
        for warning in found.warnings:
            print(f"! {warning}")
        if not found.problems:
            print("The installation works; see the warnings." if found.warnings else "The installation works.")
    if found.problems:
        exit_with_failures(found.problems)
