"""`sylpose check`: validate a recording before it is tracked."""

from __future__ import annotations

from dataclasses import dataclass

from sylpose.commands.app import command, pick
from sylpose.commands.options import BoxesFile, FrameOffset, OutFolder, RecordingOptions, StepOptions, WorldOptions


@dataclass(frozen=True, kw_only=True)
class CheckOptions(WorldOptions, StepOptions, RecordingOptions):
    """Options of `sylpose check`."""

    boxes: BoxesFile = None
    frame_offset: FrameOffset = ()
    out: OutFolder = None


@command("Validate a recording and report problems.")
def check(options: CheckOptions) -> None:
    """Validate a recording and report problems.

    Plots the rig from above and from the side in OUT/rig.png, and with --world the world axes in OUT/world.png.

    Examples:
        sylpose check recording
        sylpose check recording --calibration rig.toml --out results
    """
    from sylpose.atomic_io import make_output_folder
    from sylpose.io.calibration.world import save_world
    from sylpose.report.drawing import draw_views, draw_world_axes
    from sylpose.report.rigview import describe_rig, plot_rig
    from sylpose.runs import check as checks
    from sylpose.runs import console_output, rig_evidence
    from sylpose.runs.candidates import list_frames
    from sylpose.runs.options import RunOptions
    from sylpose.runs.results_folder import check_output_folder
    from sylpose.runs.run import output_path
    from sylpose.runs.run_metadata import WORLD
    from sylpose.sync.offsets import apply_offsets, find_offsets

    session = options.apply_to(options.open(options.boxes, options.frame_offset))
    run_options = pick(options, RunOptions, offsets=find_offsets(session))
    session = apply_offsets(session, run_options.offsets or {})
    folder = output_path(session, options.out)
    check_output_folder(session, folder)
    pictures = [make_output_folder(folder) / "rig.png"]
    locations = {name: checks.locate_object(session.select_object(name)) for name in session.objects}
    location = next(iter(locations.values()))
    console = console_output.make_console()
    console.print(console_output.format_headline(session))
    console.print()
    rows = console_output.build_rig_rows(session, describe_rig(session.rig, location.center))
    console_output.print_table(console, console_output.RIG_HEADER, rows)
    console.print()
    console_output.print_facts(console, checks.collect_facts(session, locations))
    plot_rig(session.rig, pictures[0], location.center if location.radius else None, location.radius)
    errors = checks.list_errors(locations)
    target = None if errors else checks.find_tracking_target(session, run_options)
    views = [] if target is None else target.views
    if views:
        pictures.append(folder / "target.png")
        draw_views(pictures[-1], session.rig.names, views)
    if session.world is not None:
        pictures.append(folder / "world.png")
        draw_world_axes(pictures[-1], views[0].frames.images if views else [None] * len(session.rig), session.rig)
        save_world(session.world, folder / WORLD)
    console_output.print_files(console, "Pictures" if len(pictures) > 1 else "Picture", pictures)
    console.print()
    if target is not None:
        console.print(f"Target: {target.description}.", highlight=False)
    problems, findings = checks.list_warnings(session, locations, options.start), None
    if target is not None:
        unusable = list[str]()
        frames = list_frames(session, run_options, unusable.append)
        findings = rig_evidence.examine_rig(session.rig, *frames, target.f_ratio)
        problems += dict.fromkeys(unusable)
        problems += rig_evidence.describe_findings(session, findings)
        # What was or was not found to move under a wrong rig is no problem of its own.
        problems += [] if findings.is_rig_wrong else target.warnings
    console_output.print_warnings(console, problems)
    if errors:
        raise ValueError(f"{'; '.join(errors)}; correct the boxes: {checks.boxes_hint(session)}")
    if findings is not None and findings.is_contradicted:
        console.print("Not ready to track: poses would be wrong; see the warnings above.")
    elif problems:
        console.print("Can be tracked; see the warnings above.")
    else:
        axis_note = checks.describe_axis_miss(session.rig)
        console.print(f"Can be tracked. {axis_note}" if axis_note else "Ready to track.")
