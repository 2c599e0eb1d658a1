"""`sylpose node`, `sylpose nodes`, `sylpose network init` and `sylpose network demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.common import Seed, app, examples, fail, one_of, spoken
from sylpose.methods import FEATURES, METHODS, MODES, features_of

__all__ = ["demo_of_network", "init", "node", "nodes"]

LOOPBACK = "127.0.0.1:0"

network_app = typer.Typer(help="Networks of nodes: keys, a demonstration.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(network_app, name="network")

Network = Annotated[
    str, typer.Option("--network", metavar="NAME", help="Nodes of the same name and rig find each other.")
]
Listen = Annotated[
    str,
    typer.Option("--listen", metavar="HOST:PORT", help="Where others reach this node; only this machine by default."),
]
Connect = Annotated[
    list[str] | None,
    typer.Option("--connect", metavar="HOST:PORT", help="A node to begin with; may be given several times."),
]
Keys = Annotated[Path | None, typer.Option("--keys", metavar="DIR", help="This node's keys: see sylpose network init.")]


@app.command(
    short_help="One camera on one machine, among others.",
    epilog=examples(
        "sylpose node cam_0 --calibration rig.toml --source recording/cam_0.mp4 --boxes recording/boxes.toml",
        "sylpose node cam_2 --calibration rig.toml --source 0 --rate 30 --listen 192.168.1.12:7447 --keys keys",
        "sylpose node --view top --calibration virtual.toml",
    ),
)
@spoken
def node(
    camera: Annotated[
        str | None, typer.Argument(metavar="CAMERA", help="The camera's name in the calibration.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", metavar="FILE", help="Of the whole rig, the same at all nodes.")
    ] = None,
    source: Annotated[
        str | None,
        typer.Option("--source", metavar="DEVICE|FILE|URL|FOLDER", help="Its images: a camera's number, a video, ..."),
    ] = None,
    boxes: Annotated[
        Path | None,
        typer.Option("--boxes", metavar="FILE", help="The object's boxes in the first frame, the same at all nodes."),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(
            "--view", metavar="CAMERA", help="A node without images: the others' poses as this camera sees them."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where its results go; ./sylpose_CAMERA by default.")
    ] = None,
    network: Network = "sylpose",
    listen: Listen = LOOPBACK,
    connect: Connect = None,
    keys: Keys = None,
    multicast: Annotated[
        bool, typer.Option("--multicast/--no-multicast", help="Look for others on the network that it listens to.")
    ] = True,
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", min=0.001, help="Frames per second, the same at all nodes.")
    ] = None,
    speed: Annotated[
        float,
        typer.Option("--speed", metavar="X", min=0, help="Of a recording: 2 is twice as fast, 0 as fast as it goes."),
    ] = 1.0,
    wait: Annotated[
        float,
        typer.Option("--wait", metavar="SEC", min=0, help="For the other cameras at first, before it begins without."),
    ] = 10.0,
    patience: Annotated[
        float,
        typer.Option(
            "--patience", metavar="SEC", min=0.1, help="With a camera that is there and does not get on with it."
        ),
    ] = 10.0,
    method: Annotated[
        str, typer.Option(metavar="|".join(METHODS), help="As of sylpose track.", callback=one_of(METHODS))
    ] = METHODS[0],
    features: Annotated[
        str, typer.Option(metavar="|".join(FEATURES), help="As of sylpose track.", callback=one_of(FEATURES))
    ] = FEATURES[0],
    mode: Annotated[
        str,
        typer.Option(
            metavar="|".join(MODES), help="As one process, or in fewer rounds, nearly so.", callback=one_of(MODES)
        ),
    ] = MODES[0],
    seed: Seed = 0,
) -> None:
    """One camera of a rig on its own machine: it sees its own images, and finds the pose together with the other cameras.

    All come to the same poses, those that one computer with all images would find; who comes late or comes back takes part
    again. Writes CAMERA.tum and CAMERA.csv into OUT, and tells each pose to whoever listens (docs/network.md).
    """
    from sylpose import calibration as calibrations
    from sylpose.app.view import looked_up
    from sylpose.network.zenoh_transport import Links

    _need_zenoh()
    if calibration is None:
        raise ValueError("--calibration FILE is needed: the rig's, the same at all nodes")
    links = Links(listen, tuple(connect or ()), keys, multicast)
    if view is not None:
        from sylpose.app.node_view import view_node_aloud

        if camera is not None or source is not None:
            raise ValueError("--view is a node without a camera: give no CAMERA and no --source with it")
        seen = looked_up(view, calibration)
        if not view_node_aloud(seen, network, links, out if out is not None else Path(f"sylpose_{view}")):
            fail([f"{view}: nobody in network {network} told a pose"])
        return
    from sylpose.app.node import Asked, node_aloud

    if camera is None or source is None:
        raise ValueError("a node is a camera and its images: CAMERA and --source are needed (or --view CAMERA)")
    features_of(method, features)
    links = Links(listen, tuple(connect or ()), keys, multicast, calibrations.load(calibration).names)
    asked = Asked(
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
    if not node_aloud(asked):
        fail([f"{camera}: no pose was found"])


@app.command(
    short_help="Which nodes are there, and how they are.",
    epilog=examples("sylpose nodes", "sylpose nodes --network lab --keys keys"),
)
@spoken
def nodes(
    network: Network = "sylpose",
    listen: Listen = LOOPBACK,
    connect: Connect = None,
    keys: Keys = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="SEC", min=0.1, help="How long to listen.")] = 2.5,
) -> None:
    """The nodes of a network: what they do, with whom, frames, latency, bytes and rounds per frame, clocks."""
    from sylpose.app.node import nodes_aloud
    from sylpose.network.zenoh_transport import Links

    _need_zenoh()
    if not nodes_aloud(network, Links(listen, tuple(connect or ()), keys), seconds):
        fail([f"nobody is in network {network}"])


@network_app.command(
    epilog=examples("sylpose network init keys --calibration rig.toml --host cam0.lab --host cam1.lab")
)
@spoken
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the keys go.")],
    calibration: Annotated[
        Path, typer.Option("--calibration", metavar="FILE", help="Of the rig: a key for each camera.")
    ],
    host: Annotated[
        list[str] | None, typer.Option("--host", metavar="NAME", help="A machine's name or address; may be repeated.")
    ] = None,
) -> None:
    """Make a certificate authority and a key for each camera.

    Copy ca.pem, CAMERA.pem and CAMERA.key to that camera's machine; ca.key makes further keys and stays here.
    """
    from sylpose import calibration as calibrations
    from sylpose.app import console_output
    from sylpose.network.keys import make_keys

    _need_zenoh()
    rig = calibrations.load(calibration)
    written = make_keys(folder, rig.names, host or ())
    if written:
        console_output.print_files(console_output.make_console(), "Files", written)
    else:
        print(f"{folder}: has all keys already")


@network_app.command("demo", epilog=examples("sylpose network demo", "sylpose network demo --frames 120 --out block"))
@spoken
def demo_of_network(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where recording and results go.")] = Path(
        "sylpose_network_demo"
    ),
    frames: Annotated[int, typer.Option(metavar="N", min=20, help="How many.")] = 60,
    speed: Annotated[float, typer.Option("--speed", metavar="X", min=0, help="0: as fast as it goes.")] = 0.1,
    seed: Seed = 0,
) -> None:
    """Four nodes, a process each, on a rendered recording; one is killed in the middle and started again.

    Draws all four answers over the truth, OUT/network.png.
    """
    from sylpose.app.network_demo import network_demo_aloud

    _need_zenoh()
    if failures := network_demo_aloud(out, frames=frames, speed=speed, seed=seed):
        fail(failures)


def _need_zenoh() -> None:
    from importlib.util import find_spec

    missing = [name for name in ("zenoh", "cryptography") if find_spec(name) is None]
    if missing:
        raise ValueError("nodes need the extra [network]: pip install 'sylpose[network]'")
