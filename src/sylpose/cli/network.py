"""`sylpose node`, `sylpose nodes`, `sylpose network init` and `sylpose network demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.commands.app import (
    ADVANCED,
    INPUT,
    LIVE,
    OBJECT,
    OUTPUT,
    GroupedCommand,
    app,
    exit_with_failures,
    format_examples,
    make_choice_check,
    report_errors,
)
from sylpose.commands.options import Seed
from sylpose.methods import FEATURES, METHODS, MODES, resolve_features

__all__ = ["init", "network_demo", "node", "nodes"]

LOOPBACK = "127.0.0.1:0"

network_app = typer.Typer(
    help="Create keys for a network, or run a demonstration.", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(network_app, name="network")

Network = Annotated[
    str,
    typer.Option("--network", metavar="NAME", help="Join the nodes with the same name and rig.", rich_help_panel=LIVE),
]
Listen = Annotated[
    str,
    typer.Option(
        "--listen",
        metavar="HOST:PORT",
        help="Accept connections at this address; default: from this machine only.",
        rich_help_panel=LIVE,
    ),
]
Connect = Annotated[
    list[str] | None,
    typer.Option(
        "--connect", metavar="HOST:PORT", help="Connect to this node first. Repeatable.", rich_help_panel=LIVE
    ),
]
Keys = Annotated[
    Path | None,
    typer.Option("--keys", metavar="DIR", help="Use the node's keys from sylpose network init.", rich_help_panel=LIVE),
]


@app.command(
    cls=GroupedCommand,
    short_help="Run one camera as a node of a network.",
    epilog=format_examples(
        "sylpose node cam_0 --calibration rig.toml --source recording/cam_0.mp4 --boxes recording/boxes.toml",
        "sylpose node cam_2 --calibration rig.toml --source 0 --rate 30 --listen 192.168.1.12:7447 --keys keys",
        "sylpose node --view top --calibration virtual.toml",
    ),
)
@report_errors
def node(
    camera: Annotated[
        str | None, typer.Argument(metavar="CAMERA", help="The camera's name in the calibration.")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            metavar="FILE",
            help="Read the calibration of the whole rig, identical on all nodes.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            metavar="DEVICE|FILE|URL|FOLDER",
            help="Read the images from a camera (by number), a video, a stream or a folder.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    boxes: Annotated[
        Path | None,
        typer.Option(
            "--boxes",
            metavar="FILE",
            help="Read the object's boxes in the first frame, identical on all nodes.",
            rich_help_panel=OBJECT,
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view",
            metavar="CAMERA",
            help="Run a node without images that writes the others' poses in this camera's frame.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Write the results here; default: ./sylpose_CAMERA.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    network: Network = "sylpose",
    listen: Listen = LOOPBACK,
    connect: Connect = None,
    keys: Keys = None,
    multicast: Annotated[
        bool,
        typer.Option(
            "--multicast/--no-multicast",
            help="Discover other nodes on the network of --listen.",
            rich_help_panel=LIVE,
        ),
    ] = True,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            min=0.001,
            help="Set the frame rate, identical on all nodes.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    speed: Annotated[
        float,
        typer.Option(
            "--speed",
            metavar="X",
            min=0,
            help="Set the playback speed of a recording: 2 is twice as fast, 0 as fast as possible.",
            rich_help_panel=INPUT,
        ),
    ] = 1.0,
    wait: Annotated[
        float,
        typer.Option(
            "--wait",
            metavar="SEC",
            min=0,
            help="Wait for the other cameras before starting without them.",
            rich_help_panel=LIVE,
        ),
    ] = 10.0,
    patience: Annotated[
        float,
        typer.Option(
            "--patience",
            metavar="SEC",
            min=0.1,
            help="Wait for a connected camera that makes no progress.",
            rich_help_panel=LIVE,
        ),
    ] = 10.0,
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Select the estimation method; see sylpose track.",
            callback=make_choice_check(METHODS),
            rich_help_panel=ADVANCED,
        ),
    ] = METHODS[0],
    features: Annotated[
        str,
        typer.Option(
            metavar="|".join(FEATURES),
            help="Select the features; see sylpose track.",
            callback=make_choice_check(FEATURES),
            rich_help_panel=ADVANCED,
        ),
    ] = FEATURES[0],
    mode: Annotated[
        str,
        typer.Option(
            metavar="|".join(MODES),
            help="Get the same result as one process (exact), or nearly the same in fewer rounds (compact).",
            callback=make_choice_check(MODES),
            rich_help_panel=ADVANCED,
        ),
    ] = MODES[0],
    seed: Seed = 0,
) -> None:
    """Run one camera of a rig as a node that estimates the pose jointly with the other cameras.

    A node reads only its own images. All nodes get the same poses, equal to those of one computer with all images;
    nodes may join late or rejoin. Writes CAMERA.tum and CAMERA.csv into OUT and publishes each pose (docs/network.md).
    """
    from sylpose.io import calibration as calibrations
    from sylpose.network.zenoh_transport import LinkSettings
    from sylpose.runs.view import load_camera

    _require_zenoh()
    if calibration is None:
        raise ValueError("--calibration FILE is required: the rig's, identical on all nodes")
    links = LinkSettings(listen, tuple(connect or ()), keys, multicast)
    if view is not None:
        from sylpose.commands.node_view import run_node_view_command

        if camera is not None or source is not None:
            raise ValueError("--view runs a node without a camera: give no CAMERA and no --source with it")
        virtual_camera = load_camera(view, calibration)
        if not run_node_view_command(
            virtual_camera, network, links, out if out is not None else Path(f"sylpose_{view}")
        ):
            exit_with_failures([f"{view}: no node in network {network} published a pose"])
        return
    from sylpose.commands.node import NodeOptions, run_node_command

    if camera is None or source is None:
        raise ValueError("a node requires a camera and its images: give CAMERA and --source (or --view CAMERA)")
    resolve_features(method, features)
    links = LinkSettings(listen, tuple(connect or ()), keys, multicast, calibrations.load(calibration).names)
    options = NodeOptions(
        camera,
        calibration,
        source,
        boxes,
        out,
        network,
        links,
        rate,
        speed,
        wait,
        patience,
        method,
        features,
        mode,
        seed,
    )
    if not run_node_command(options):
        exit_with_failures([f"{camera}: no pose was found"])


@app.command(
    cls=GroupedCommand,
    short_help="List nodes and their status.",
    epilog=format_examples("sylpose nodes", "sylpose nodes --network lab --keys keys"),
)
@report_errors
def nodes(
    network: Network = "sylpose",
    listen: Listen = LOOPBACK,
    connect: Connect = None,
    keys: Keys = None,
    seconds: Annotated[
        float,
        typer.Option("--seconds", metavar="SEC", min=0.1, help="Listen for this long.", rich_help_panel=LIVE),
    ] = 2.5,
) -> None:
    """List the nodes of a network: status, peers, frames, latency, bytes and rounds per frame, clocks."""
    from sylpose.commands.node import run_nodes_command
    from sylpose.network.zenoh_transport import LinkSettings

    _require_zenoh()
    if not run_nodes_command(network, LinkSettings(listen, tuple(connect or ()), keys), seconds):
        exit_with_failures([f"network {network} has no nodes"])


@network_app.command(
    short_help="Create a certificate authority and camera keys.",
    epilog=format_examples("sylpose network init keys --calibration rig.toml --host cam0.lab --host cam1.lab"),
)
@report_errors
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the keys.")],
    calibration: Annotated[
        Path, typer.Option("--calibration", metavar="FILE", help="Create one key per camera of this calibration.")
    ],
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="NAME", help="Add a machine's name or address to the certificates. Repeatable."),
    ] = None,
) -> None:
    """Create a certificate authority and a key for each camera.

    Copy ca.pem, CAMERA.pem and CAMERA.key to that camera's machine. Keep ca.key here; it signs further keys.
    """
    from sylpose.io import calibration as calibrations
    from sylpose.network.keys import make_keys
    from sylpose.runs import console_output

    _require_zenoh()
    rig = calibrations.load(calibration)
    written = make_keys(folder, rig.names, host or ())
    if written:
        console_output.print_files(console_output.make_console(), "Files", written)
    else:
        print(f"{folder}: has all keys already")


@network_app.command(
    "demo",
    cls=GroupedCommand,
    short_help="Run four nodes on a rendered recording.",
    epilog=format_examples("sylpose network demo", "sylpose network demo --frames 120 --out block"),
)
@report_errors
def network_demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Write the recording and the results here.")] = Path(
        "sylpose_network_demo"
    ),
    frames: Annotated[int, typer.Option(metavar="N", min=20, help="Render N frames.")] = 60,
    speed: Annotated[
        float, typer.Option("--speed", metavar="X", min=0, help="Set the playback speed; 0: as fast as possible.")
    ] = 0.1,
    seed: Seed = 0,
) -> None:
    """Run four nodes, one process each, on a rendered recording; kill and restart one midway.

    Plots all four results against the ground truth in OUT/network.png.
    """
    from sylpose.commands.network_demo import run_network_demo

    _require_zenoh()
    if failures := run_network_demo(out, frames=frames, speed=speed, seed=seed):
        exit_with_failures(failures)


def _require_zenoh() -> None:
    from importlib.util import find_spec

    missing = [name for name in ("zenoh", "cryptography") if find_spec(name) is None]
    if missing:
        raise ValueError("nodes require the extra [network]: pip install 'sylpose[network]'")
