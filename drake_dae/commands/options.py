"""The command line: commands, options and their help texts."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drake_dae
from drake_dae.commands.options_of_studies import (
    add_excite,
    add_identify,
    add_json,
    add_sweep,
    path_option,
    whole_option,
)
from drake_dae.scenario.shipped import DEFAULT_SCENARIO


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command and its options.

    Args:
        arguments: Those after the command's name; those of this process if None.

    Raises:
        SystemExit: They are invalid, or ask for help or the version.
    """
    parser = argparse.ArgumentParser(
        prog="drake-dae",
        description="Robots in contact: position and force tracking on Drake's systems framework.",
    )
    parser.add_argument("--version", action="version", version=drake_dae.__version__)
    commands = parser.add_subparsers(dest="command", required=True)
    listed = commands.add_parser("list", help="list the shipped scenarios")
    add_json(listed, "print names and descriptions as JSON")
    shown = commands.add_parser(
        "print", help=("print a shipped scenario, as the beginning of your own")
    )
    shown.add_argument("scenario", nargs="?", default=DEFAULT_SCENARIO, help="which one")
    shown.add_argument("--path", action="store_true", help="print where its file is instead")
    commands.add_parser("keys", help="print all keys of a scenario, as a page in Markdown")
    commands.add_parser("schema", help="print the JSON Schema of a scenario, for editors")
    explained = commands.add_parser("explain", help="print what to do about an error, by its code")
    explained.add_argument("code", nargs="?", default="", help="as E12 (default: all codes)")
    named = argparse.ArgumentParser(add_help=False)
    named.add_argument(
        "scenario",
        nargs="?",
        default=DEFAULT_SCENARIO,
        help=f"a shipped scenario or a YAML file (default: {DEFAULT_SCENARIO})",
    )
    named.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help='change the scenario, for example "integrator.accuracy=1e-8"; may be repeated',
    )
    named.add_argument(
        "--compiled",
        choices=["true", "false", "auto"],
        help="whether functions become machine code, as the scenario's key `compiled`",
    )
    run = commands.add_parser(
        "simulate",
        parents=[named],
        help="run a scenario",
        epilog=(
            "exit code: 0 if the run came to its end, 1 for an error, also where it ended "
            "early; with --check 2 if it missed its task (the first line begins with BAD): an "
            "output is not at its reference, a contact is lost or would have to pull, a link is "
            "behind a surface, a drive or a joint exceeds its limit; or if errors are not as "
            "predicted without a reason"
        ),
    )
    run.add_argument(
        "--out", type=path_option, help="folder for the results (default: runs/<scenario>-<time>)"
    )
    run.add_argument(
        "--meshcat", action="store_true", help="show the robot while it runs, in a browser"
    )
    run.add_argument(
        "--time-optimal",
        action="store_true",
        help="follow the references as paths, in the shortest time that the limits of drives and "
        "joints allow; as the scenario's key `time_optimal`",
    )
    run.add_argument(
        "--open", action="store_true", help="open the animation in a browser at the end"
    )
    run.add_argument(
        "--rollout",
        action="store_true",
        help=(
            "run the whole loop as one function, without Drake's Simulator; faster for many "
            "runs (see sweep), not for one; the record has every fixed step, or 1000 rows under "
            "error control, and is written at the end alone"
        ),
    )
    run.add_argument(
        "--check", action="store_true", help="exit code 2 for a run that missed its task"
    )
    add_json(run, "print the verdict and where the files are as JSON, and all else on stderr")
    shown = commands.add_parser(
        "play",
        help="play the animation of a run in the browser, or of several beside each other",
        description="Opens the animation of a run in the browser. Of several runs it writes a page "
        "that shows their animations beside each other, at the same time after their starts.",
    )
    shown.add_argument(
        "runs", nargs="+", type=path_option, metavar="RUN", help="the folder of a run"
    )
    shown.add_argument(
        "--out",
        type=path_option,
        metavar="FILE",
        help="the page of several runs (default: compare.html)",
    )
    examine = commands.add_parser(
        "analyze",
        parents=[named],
        help="examine a scenario without running it",
        description="Examines the robot of a scenario (relative degrees, index, Assumptions "
        "(1)-(5), zero dynamics) and what its reference takes: the nearest singularity, control "
        "and joint forces against their limits, contact forces, joint limits, and when the "
        "reference leaves what the robot can reach.",
        epilog="exit code: 0 if no problem was found, 2 if one was (the lines PROBLEM), 1 for an "
        "error",
    )
    add_json(examine, "print JSON")
    add_sweep(commands, named)
    add_identify(commands)
    add_excite(commands, named)
    _add_new(commands)
    written = commands.add_parser(
        "export",
        parents=[named],
        help="write controller, plant and loop as C99, FMUs or WebAssembly",
        description="c: writes the law, the plant and the projection of a scenario as plain C99 "
        "without dependencies, with sizes, names and units; and of a sampled law the whole "
        "controller as one step, with a class of C++ over it. `make` in the folder compiles "
        "programs that compare them with Python and with a run of Drake's Simulator. fmu: writes "
        "controller and plant as FMUs (FMI 3.0, co-simulation), with sources and a binary for this "
        "machine. wasm: writes controller, plant and loop in fixed steps as one WebAssembly "
        "module, and a module of JavaScript that loads it in a page; it needs drake_dae[compiler].",
    )
    written.add_argument("--format", choices=("c", "fmu", "wasm"), default="c", help="(default: c)")
    written.add_argument(
        "--out",
        type=path_option,
        help="folder for the files (default: <scenario>_<format>, _c99 for c)",
    )
    add_json(written, "print the names of the files as JSON")
    _add_benches(commands, named)
    film = commands.add_parser(
        "render",
        help="render a run into a GIF, an MP4 or a strip of pictures",
        description=(
            "Renders the run in a folder, with the paths and the forces of its contacts. "
            "It needs no screen and no browser."
        ),
    )
    film.add_argument(
        "folder", type=path_option, help="the folder of a run, as runs/seven_joint_wall"
    )
    film.add_argument(
        "--out",
        type=path_option,
        help="a .gif or .mp4 (by ffmpeg), or a .png for four moments side by side (default: "
        "film.gif in the folder)",
    )
    blocks = commands.add_parser(
        "diagram",
        parents=[named],
        help="draw the blocks of a scenario's loop and their wires",
        description="Draws the Drake diagram of a scenario: its blocks, and the wires with the "
        "names of their ports. Graphviz's program `dot` draws it; a .dot is written without it.",
    )
    blocks.add_argument(
        "--out",
        type=path_option,
        metavar="FILE",
        help="a .svg, .png, .pdf or .dot (default: <scenario>.svg)",
    )
    drawn = commands.add_parser(
        "plot",
        help="draw signals of runs over each other",
        description="Draws outputs of runs with their references, or other signals by name, with "
        "the errors as predicted beside those measured, into one picture.",
    )
    drawn.add_argument(
        "runs",
        nargs="+",
        type=path_option,
        metavar="RUN",
        help="a folder of a run, or a record.npz",
    )
    drawn.add_argument(
        "--signals",
        action="append",
        default=[],
        metavar="NAMES",
        help="what to draw, as wall.force,control or state/joint1; may be repeated (default: all "
        "outputs)",
    )
    drawn.add_argument(
        "--errors", action="store_true", help="|z - r| of outputs, over the predicted one"
    )
    drawn.add_argument(
        "--out",
        type=path_option,
        default=Path("plot.png"),
        metavar="FILE",
        help="a .png, .pdf or .svg (default: plot.png)",
    )
    kept = commands.add_parser("cache", help="show the machine code in the cache, or remove it")
    kept.add_argument("--clear", action="store_true", help="remove it all")
    options = parser.parse_args(arguments)
    if options.command == "simulate" and options.rollout and options.meshcat:
        parser.error("--rollout shows nothing while it runs; leave out --meshcat")
    return options


def _add_benches(commands: Any, named: argparse.ArgumentParser) -> None:
    """The commands whose robot is dragged, pushed and steered."""
    page = commands.add_parser(
        "page",
        parents=[named],
        help="write a scenario as one HTML file in which it runs",
        description="Writes plant, law and references as WebAssembly into one HTML file that needs "
        "neither server nor network: sliders, a target and surfaces that are dragged, links that "
        "are pushed, plots of force and error with the prediction. It needs drake_dae[compiler].",
    )
    page.add_argument("--out", type=path_option, metavar="FILE", help="(default: <scenario>.html)")
    page.add_argument(
        "--shared-bundle",
        type=path_option,
        metavar="FILE",
        help="where to write the bundle that draws, 2.2 MB, for several pages; without, it is in "
        "the page",
    )
    page.add_argument("--open", action="store_true", help="open the page in a browser")
    add_json(page, "print the files with their sizes as JSON")
    bench = commands.add_parser(
        "live",
        parents=[named],
        help="run a scenario in real time, and change it in a browser meanwhile",
        description="The bench of `page`, run here by Drake's Simulator, for every scenario, also "
        "with Drake's own contact, contacts that open, and tasks. Only this machine reaches it. "
        "Its button save writes the record, the scenario and what was commanded.",
    )
    bench.add_argument(
        "--port", type=whole_option, default=0, help="(default: any port that is free)"
    )
    bench.add_argument("--no-browser", action="store_true", help="print the address alone")
    bench.add_argument(
        "--replay",
        type=path_option,
        metavar="FILE",
        help="run what was commanded in a bench again, commands.json, and write its record",
    )
    bench.add_argument(
        "--out", type=path_option, help="folder for what is saved (default: live/<scenario>-<time>)"
    )


def _add_new(commands: Any) -> None:
    begin = commands.add_parser(
        "new",
        help="write a scenario for a robot of your own",
        description=(
            "Writes a scenario for a robot of which only the file is known: it finds "
            "base, chain and tip, locks grippers and wheels, places a surface within "
            "good reach of the tip, and makes the tip circle and press there within the "
            "limits. Comments give the reasons."
        ),
    )
    begin.add_argument("robot", help="a URDF, SDFormat, MJCF or model-directives file")
    begin.add_argument(
        "--surface",
        choices=["plane", "cylinder", "sphere"],
        default="plane",
        help="the surface (default: plane)",
    )
    begin.add_argument(
        "--tip",
        default="",
        metavar="LINK[:x,y,z]",
        help=(
            "the link or frame in contact, and the contact point in it in m (default: the end "
            "of the longest chain)"
        ),
    )
    begin.add_argument(
        "--out", type=path_option, metavar="FILE", help="the file (default: <robot>_<surface>.yaml)"
    )
