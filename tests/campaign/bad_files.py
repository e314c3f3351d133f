"""Robots, records and command lines with a mistake, read by what users read them with."""

import contextlib
import io
import os
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from campaign.outcomes import RAW, REFUSED, Outcome, checked

from drake_dae import Record
from drake_dae.cli import main
from drake_dae.scenario.robot_file.reading import finalize, read_robot
from drake_dae.scenario.robot_file.robot import Robot
from drake_dae.scenario.shipped import FOLDER

ROBOTS = Path(__file__).parents[1] / "scenario" / "robots"

CELLS = (
    "",
    "nan",
    "inf",
    "-inf",
    "1e300",
    "1e-320",
    "1_0",
    "0x1",
    "1,5",
    "\u0661",
    "abc",
    "\0",
    "--1",
    "1e",
    "1" * 400,
)
"""What stands in the place of a number and is none, or none of use."""

SIZES = ("(1000000, 1000000)", "(-3, 3)", "(3,)", "()", "(3, 3, 3)", "(2, 10)", "'a'", "(1e3, 3)")
KINDS = ("<f8", "<f4", "<i2", "<c16", "|b1", "<U4", "|O", "<M8[s]", "nonsense", "<f16")


def attempt(seed: int, folder: Path) -> Outcome:
    """Reads something bad."""
    choice = random.Random(seed)
    kind = choice.choices((_robot, _record, _command), (4, 2, 5))[0]
    return kind(choice, folder)


def _outcome(what: str, read: Callable[[], object], excuse: str) -> Outcome:
    with checked(what) as outcome:
        read()
        outcome.residual = outcome.off = 0.0
        outcome.accepted(excuse)
    return outcome


def _npy(choice: random.Random) -> tuple[str, bytes, str]:
    size, kind = choice.choice(SIZES), choice.choice(KINDS)
    head = f"{{'descr': '{kind}', 'fortran_order': {choice.random() < 0.2}, 'shape': {size}, }}"
    text = head.encode().ljust(117) + b"\n"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + np.zeros(20).tobytes()
    good = size == "(2, 10)" and kind in ("<f8", "<f4", "<i2")
    return f"{kind} of {size}", data, "numbers that fit" if good else ""


def _damaged(data: bytes, choice: random.Random) -> tuple[str, bytes]:
    """Bytes that end too early, or lack, have or change something in the middle."""
    place = choice.randrange(max(1, len(data)))
    how = choice.choice(("cut", "gap", "insert", "change", "twice"))
    if how == "cut":
        return f"cut at {place}", data[:place]
    if how == "twice":
        return "twice", data + data
    if how == "gap":
        return f"gap at {place}", data[:place] + data[place + choice.randint(1, 9) :]
    some = bytes(choice.randrange(256) for _ in range(choice.randint(1, 4)))
    rest = data[place:] if how == "insert" else data[place + len(some) :]
    return f"{how} {some!r} at {place}", data[:place] + some + rest


# Robots.


def _robot(choice: random.Random, folder: Path) -> Outcome:
    """An SDFormat, MJCF, URDF or directives file with something damaged, or with a loop."""
    file = choice.choice(
        (
            ROBOTS / "five_bar.sdf",
            ROBOTS / "leaning_arm.xml",
            FOLDER / "models" / "three_fingers.dmd.yaml",
            FOLDER / "models" / "boom.urdf",
            FOLDER / "models" / "held_box.urdf",
        )
    )
    text, numbers = file.read_text("utf-8"), []
    numbers = [i for i, word in enumerate(text.split(" ")) if any(c.isdigit() for c in word)]
    how = choice.choice(("damage", "damage", "number", "number", "line", "include"))
    if how == "number" and numbers:
        words = text.split(" ")
        place, new = choice.choice(numbers), choice.choice(CELLS)
        words[place], how = new, f"{words[place][:20]!r} becomes {new[:8]!r}"
        text = " ".join(words)
    elif how == "include":
        loops = {
            ".sdf": "<include><uri>package://mine/robot.sdf</uri></include>",
            ".xml": '<include file="robot.xml"/>',
        }
        place = text.rfind("</")
        text = text[:place] + loops.get(file.suffix, "<include/>") + text[place:]
    else:
        how, data = _damaged(text.encode(), choice)
        text = data.decode("utf-8", errors="replace")
    name = "robot" + "".join(file.suffixes)
    (folder / name).write_text(text, "utf-8")
    (folder / "package.xml").write_text("<package format='2'><name>mine</name></package>")

    def read() -> None:
        plant, _ = read_robot(Robot(file=str(folder / name)))
        finalize(plant)

    return _outcome(f"{file.name}: {how}", read, "what is left is a robot")


# Records.


def _record(choice: random.Random, folder: Path) -> Outcome:
    """A record that is damaged, or whose arrays claim what they do not hold."""
    file = folder / "record.npz"
    Record(np.arange(3.0), {}).save(file)
    how = choice.choice(("damage", "damage", "member", "rows"))
    if how == "rows":
        head = choice.choice(("[" * 9999, '{"signals": 1}', '{"signals": {"a": [[1]]}}', "{}", "{"))
        file.write_bytes(head.encode() + b"\n" + bytes(100))
    elif how == "member":
        _, data, _ = _npy(choice)
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("time.npy", data)
    else:
        how, data = _damaged(file.read_bytes(), choice)
        file.write_bytes(data)
    return _outcome(f"record: {how}", lambda: Record.load(file), "what is left is a record")


# Commands.

WORDS = (
    "two_link_wall",
    "no_such",
    "",
    ".",
    "/dev/zero",
    "a\u00e9",
    "--set",
    "--set=duration=0.01",
    "--set=duration=-1",
    "--set=duration=1e400",
    "--set=duration=1_0",
    "--set=a.b=1",
    "--set==",
    "--set=sampling={period: 0.001, delay: 1.0e+6}",
    "--set=write={}",
    "--set=start={}",
    "--set=references={tool.z: !Csv {file: /dev/zero, columns: [z]}}",
    '--set=constraints.0.name="\\ud800"',
    "--out=",
    "--out",
    "--out=results",
    "--out=/dev/null/a",
    "--json",
    "--check",
    "--rollout",
    "--force",
    "--nonsense",
    "-h",
    "--surface=plane",
    "--surface=cube",
    "--tip=a:1,2,nan",
    "--tip=a:1_0,2,3",
    "--tip=:1,2,3",
    "--path",
)

VARY = (
    "start.errors.tool.z=-1e308..1e308:3",
    "start.errors.tool.z=0..1e300:2",
    "law.gains.all=[]",
    "a=",
    "=",
    "sensors.force.seed=0..1e300",
    "duration=1..0:3",
    "duration=1..2",
    "law.gains.all=0..1:999999999",
    "x=[1, [2]]",
    "plant.parameters.no=[1]",
    "duration=[nothing, 1]",
    "duration=[[[[1]]]]",
    "duration=nan..1:2",
)


def _command(choice: random.Random, folder: Path) -> Outcome:
    """A command line with random words, as far as it goes in a moment."""
    command = choice.choice(
        ("simulate", "analyze", "sweep", "plot", "play", "new", "print", "list", "export")
    )
    words = [command, *choice.sample(WORDS, choice.randint(0, 3))]
    if command == "sweep":
        words += [
            f"--vary={choice.choice(VARY)}",
            *choice.choice(([], ["--random=2"], ["--together"])),
        ]
    if command in ("simulate", "export") and not any(w.startswith("--out") for w in words):
        words.append("--out=results")
    if command in ("simulate", "sweep", "analyze", "export"):
        quick = ["--set=duration=0.01", "--set=write={plots: false, animation: false}"]
        words[1:1] = ["two_link_wall", *quick] if choice.random() < 0.7 else quick
    told, here = io.StringIO(), os.getcwd()
    outcome = Outcome(f"drake-dae {' '.join(words)}"[:200], residual=0.0, off=0.0)
    with checked(outcome.what) as caught:
        os.chdir(folder)
        try:
            with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
                code = main(words)
        except SystemExit as error:
            code = error.code
        finally:
            os.chdir(here)
        text = told.getvalue()
        if code == 0:
            caught.residual = caught.off = 0.0
            caught.text = "a command that makes sense"
        elif code in (1, 2) and ("error: " in text or "PROBLEM" in text):
            caught.kind, caught.text = REFUSED, text[-200:]
        elif code == 2 and "--check" in words:
            caught.text = "it missed its task"
        else:
            caught.kind, caught.text = RAW, f"exit code {code}: {text[-200:]}"
    return caught
