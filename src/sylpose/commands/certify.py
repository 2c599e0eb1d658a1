"""`sylpose certify`: how accurate a recording's result is, measured with the recording itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from sylpose.commands.app import OBJECT, command, exit_with_failures, option
from sylpose.commands.options import (
    BoxesFile,
    FrameOffset,
    OutFolder,
    RangeOptions,
    RecordingOptions,
    SeedOptions,
    Unit,
)

if TYPE_CHECKING:
    from sylpose.runs.certify import Certificate


@dataclass(frozen=True, kw_only=True)
class CertifyOptions(SeedOptions, RangeOptions, RecordingOptions):
    """Options of `sylpose certify`.

    Attributes:
        candidate: Without boxes, certify body N of those that sylpose check draws with the same --start and --stop.
        bar: Names of two objects at the ends of a stiff bar, A,B: their relative pose must be constant (ASTM E3064).
    """

    boxes: BoxesFile = None
    candidate: Annotated[int | None, option("--object N", OBJECT, min=1)] = None
    bar: Annotated[str | None, option("--bar A,B", OBJECT)] = None
    frame_offset: FrameOffset = ()
    out: OutFolder = None
    unit: Unit = None

    def __post_init__(self) -> None:
        """Check the names of the bar's objects."""
        super().__post_init__()
        if self.bar is not None and self.bar_ends is None:
            raise ValueError(f"--bar: the names of two objects are expected, such as left,right, got {self.bar!r}")

    @property
    def bar_ends(self) -> tuple[str, str] | None:
        """Return the names of the bar's objects; None without two of them."""
        names = [] if self.bar is None else [name.strip() for name in self.bar.split(",")]
        return (names[0], names[1]) if len(names) == 2 and all(names) else None


@command("Measure the accuracy of a recording's result.")
def certify(options: CertifyOptions) -> None:
    """Measure how accurate a recording's result is, without ground truth.

    Tracks the recording with all cameras, with parts of them and backwards, and compares the results: the error of the
    motion, and a factor for the stated standard deviations. Writes certificate.html, certificate.json and
    certificate.csv into OUT. Takes five to eight times as long as sylpose track. Exit code 1 if nothing could be
    certified.

    Examples:
        sylpose certify recording
        sylpose certify recording --bar left,right --out certificate
    """
    from rich.progress import Progress

    from sylpose.runs import certificate_page, console_output
    from sylpose.runs.certify import certify_session, check_bar
    from sylpose.runs.check import check_session
    from sylpose.runs.precompile import compile_with_progress
    from sylpose.runs.results_folder import check_output_folder
    from sylpose.runs.world import apply_world_and_unit

    session = apply_world_and_unit(options.open(options.boxes, options.frame_offset), None, options.unit)
    folder = session.path / "sylpose" if options.out is None else options.out
    check_output_folder(session, folder)
    check_bar(session, options.bar_ends)
    console, stderr = console_output.make_console(), console_output.make_console(stderr=True)
    console.print(console_output.format_headline(session))
    console_output.print_warnings(console, check_session(session, options.start))
    compile_with_progress(console)
    with Progress(console=stderr, transient=True, disable=not stderr.is_terminal) as bar:
        task = bar.add_task("Tracking")

        def show(label: str, done: int, total: int) -> None:
            bar.update(task, description=label, completed=done, total=total)

        try:
            certificate = certify_session(
                session,
                start=options.start,
                stop=options.stop,
                seed=options.seed,
                candidate=options.candidate,
                bar=options.bar_ends,
                progress=show,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted; nothing was written into {folder}") from None
    console.print()
    rows = [row for item in certificate.objects for row in _table_rows(item, len(certificate.objects) > 1)]
    console_output.print_table(
        console, ("", "error (rms)", "95 % bound", "factor on sd", "95 %", "independent frames"), rows
    )
    if (found := certificate.bar) is not None:
        console.print()
        rows = certificate_page.build_bar_rows(found, session.rig.unit)
        console_output.print_table(console, ("Bar: deviation", "rms", "maximum", "99.7th percentile"), rows)
    console.print()
    remarks = [remark for item in certificate.objects for remark in item.remarks]
    console_output.print_warnings(console, [*certificate.problems, *remarks])
    files = certificate_page.write_certificate(certificate, session, folder)
    console.print("Not seen by these tests: errors that all cameras share, such as a wrong scale of the calibration.")
    console_output.print_files(console, "Files", files)
    console_output.print_page_hint(console, files)
    if all(item.rotation is None or item.rotation.is_lower_bound for item in certificate.objects):
        exit_with_failures(["nothing could be certified: no part of the cameras followed the object"])


def _table_rows(item: Certificate, is_named: bool) -> list[list[str]]:
    from sylpose.runs.certificate_page import format_error, format_number, list_quantities

    rows = []
    for quantity in list_quantities(item):
        label = f"{item.name}, {quantity.name}" if is_named else quantity.name
        error, estimate = format_error(quantity)[0], quantity.estimate
        if estimate is None or estimate.is_lower_bound:
            rows.append([label, error, *["-"] * 4])
            continue
        interval = " to ".join(map(format_number, estimate.factor_interval))
        numbers = format_number(estimate.factor), interval, format_number(estimate.n_effective)
        rows.append([label, error, quantity.format(estimate.bound), *numbers])
    return rows
