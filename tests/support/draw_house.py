"""Draws the house: rooms, their files, and who imports whom. Run by `make house`."""

import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import NamedTuple

from house import FLOORS, PAPER, ROOMS, imports, room
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, PathPatch, Polygon
from matplotlib.path import Path as Curve

# What each room holds, in a few words, and the colour of its imports.
LOOKS = {
    "__main__": ("python -m drake_dae", "#5c6b7a"),
    "cli": ("the command drake-dae", "#5c6b7a"),
    "commands": ("what each command does", "#5c6b7a"),
    "drake_dae": ("the public names", "#8a7f6d"),
    "studies": ("many runs of one scenario", "#a8443f"),
    "scenario": ("scenario files: forms, robots, starts", "#b5527a"),
    "running": ("rollouts, export to C", "#a05aa0"),
    "diagrams": ("closed loops, wired with DiagramBuilder", "#9a4fb0"),
    "pictures": ("plots, animation, film, Meshcat", "#7d55c0"),
    "simulation": ("runs and records", "#6a5bc0"),
    "compiler": ("diagrams as functions, one for each rate", "#5560c0"),
    "systems": ("Drake LeafSystems", "#4f62b8"),
    "blocks": ("what all blocks share", "#4f70b8"),
    "robots": ("section 3: robots as DaeSystems", "#2b84b5"),
    "symbolic": ("from pydrake.symbolic", "#2a9d8f"),
    "analysis": ("what the theory says", "#4d9a4a"),
    "references": ("what is wanted, over time", "#c79a1e"),
    "dae": ("sections 1 and 2, in the order of the paper", "#c77d1e"),
    "trace": ("CasADi alone: functions, derivatives, Newton", "#b8493c"),
    "arguments": ("annotations as checks", "#7a6a5a"),
    "arrays": ("checked numbers", "#7a6a5a"),
    "files": ("what users name, read", "#7a6a5a"),
    "errors": ("exceptions", "#7a6a5a"),
}
INK, WHITE = "#27303a", "#fbfaf7"

# Lengths are in tenths of an inch, y points down. The house stands between two sides.
LEFT, RIGHT = 0.0, 100.0
MIDDLE = 36.0  # Where the right one of neighbours begins.
NAME, LINE, BETWEEN = 4.0, 2.7, 0.5  # Heights of a room's name, of a line of files, of a gap.
COLUMN = 15.5  # The width of the names of folders, at the left of their files.
PITCH = 1.5  # Between arrows.
FIRST_LANE, LANE = 3.6, 1.7
# What every room takes stands in one row, and no arrows lead there.
GROUND = tuple(room for floor in FLOORS[: FLOORS.index(("trace",))] for room in floor)


class Box(NamedTuple):
    """A room's place, from its upper left corner."""

    x: float
    y: float
    width: float
    height: float


def draw(path: Path) -> None:
    """Writes the picture as a PNG."""
    found = imports()
    arrows = Counter(
        (room(module), room(other))
        for module, imported in found.items()
        for other in imported
        if other.split(".")[0] == "drake_dae" and room(other) not in (room(module), *GROUND)
    )
    files = {name: _files(found, name) for name in ROOMS}
    boxes = _boxes(files, arrows)
    bottom = max(box.y + box.height for box in boxes.values())
    sources = [{a for a, b in arrows if _side((a, b)) == side} for side in (0, 1)]
    outside = [FIRST_LANE + LANE * len(one) + 1.0 for one in sources]
    low, high, top = LEFT - outside[0], RIGHT + outside[1], -13.0
    figure = Figure(((high - low) / 10, (bottom + 4.0 - top) / 10), facecolor=WHITE)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(low, high), ylim=(bottom + 4.0, top))
    axes.set_axis_off()
    axes.text(LEFT, -7.8, "The house of drake_dae", size=22, weight="bold", color=INK)
    axes.text(
        LEFT,
        -2.6,
        "A floor imports only from floors below it, and neighbours not from each other. "
        "A room's imports run down the lane of its\ncolour; the numbers count them. Every room may "
        "import the ground, which has no arrows.",
        size=9.5,
        color=INK,
    )
    for right in (True, False):
        _draw_arrows(axes, boxes, arrows, right)
    for name, box in boxes.items():
        _draw_room(axes, name, box, files[name])
    figure.savefig(path, dpi=110)


def _paper_place(folder: str) -> str:
    """What sorts folders of dae as in the paper, and those inside after their own."""
    return f"{PAPER.index(folder.split('/')[0]):02}{folder}"


def _files(found: dict[str, set[str]], name: str) -> dict[str, list[str]]:
    """The files of a room by folder, "" first; dae names its folders among its files, in order."""
    files = defaultdict(list)
    for module in sorted(found):
        parts = module.split(".")[1:]
        if room(module) == name and len(parts) > 1 and parts[-1] != "__init__":
            files["/".join(parts[1:-1])].append(parts[-1])
    if name == "dae":
        paper = [place for file in PAPER for place in (file, f"{file}/")]
        files[""] += [f"{folder}/" for folder in files if folder and "/" not in folder]
        files[""].sort(key=paper.index)
        return dict(sorted(files.items(), key=lambda own: own[0] and _paper_place(own[0])))
    return dict(sorted(files.items()))


def _boxes(files: dict[str, dict[str, list[str]]], arrows: Counter) -> dict[str, Box]:
    """Floors above each other; of neighbours the last one to the right, the others at its left."""

    def height(name: str, width: float) -> float:
        own = files[name]
        lines = sum(len(_lines(labels, width - _column(own))) for labels in own.values())
        text = NAME + LINE * lines + BETWEEN * len(own) + 0.4
        return max(text, PITCH * (1 + max(len(_takers(arrows, name, side)) for side in (0, 1))))

    boxes, y = {}, 0.0
    for floor in reversed(FLOORS):
        if floor[0] in GROUND:
            continue
        *aside, last = floor
        left = MIDDLE if aside else LEFT
        tall = height(last, RIGHT - left)
        if aside:
            wide, gap = MIDDLE - LEFT - 2.4, 2.0
            heights = [height(name, wide) for name in aside]
            spare = tall - sum(heights) - gap * (len(aside) - 1)
            tall -= min(spare, 0.0)
            top = y
            for name, own in zip(aside, heights, strict=True):
                own += max(spare, 0.0) / len(aside)
                boxes[name] = Box(LEFT, top, wide, own)
                top += own + gap
        boxes[last] = Box(left, y, RIGHT - left, tall)
        y += tall + 2.4
    wide = (RIGHT - LEFT + 2.0) / len(GROUND)
    for place, name in enumerate(GROUND):
        boxes[name] = Box(LEFT + place * wide, y, wide - 2.0, NAME + 0.4)
    return boxes


def _column(files: dict[str, list[str]]) -> float:
    """Room for the names of folders, if there are any."""
    return COLUMN if any(files) else 0.0


def _side(pair: tuple[str, str]) -> int:
    """1 for arrows at the right; 0 at the left, for rooms that do not reach the right side."""
    aside = {name for floor in FLOORS for name in floor[:-1]}
    return int(not aside & set(pair))


def _takers(arrows: Counter, name: str, side: int) -> list[str]:
    """Who imports from a room, by an arrow on one side; from the top floor down."""
    takers = {a for (a, b) in arrows if b == name and _side((a, b)) == side}
    return sorted(takers, key=ROOMS.index, reverse=True)


def _label_width(file: str) -> float:
    return 0.83 * len(file) + 1.8


def _lines(labels: list[str], width: float) -> list[list[tuple[float, str]]]:
    """The labels of a folder in lines, each label with its distance from the left."""
    lines, x = [], width
    for label in labels:
        size = _label_width(label)
        if x + size > width - 3.2:
            lines.append([])
            x = 0.0
        lines[-1].append((x, label))
        x += size + 0.9
    return lines


def _draw_room(axes: Axes, name: str, box: Box, files: dict[str, list[str]]) -> None:
    (x, y, width, height), (holds, colour) = box, LOOKS[name]
    for face, edge, alpha in (
        (WHITE, "none", 1.0),
        (colour, "none", 0.10),
        ("none", colour, 1.0),
    ):
        style = "round,pad=0,rounding_size=0.9"
        axes.add_patch(
            FancyBboxPatch(
                (x, y), width, height, style, fc=face, ec=edge, alpha=alpha, lw=1.6, zorder=3
            )
        )
    title = axes.text(
        x + 1.6,
        y + 2.9,
        f"{name}/" if files else name,
        size=13,
        weight="bold",
        color=colour,
        zorder=4,
    )
    axes.annotate(
        holds,
        (1, 0),
        xycoords=title,
        xytext=(10, 3.2),
        textcoords="offset points",
        size=9.5,
        color=INK,
        zorder=4,
    )
    y += NAME
    column = _column(files)
    for folder, labels in files.items():
        if folder:
            label = folder if len(folder) < 20 else f".../{folder.split('/')[-1]}"
            axes.text(x + 1.7, y + 1.6, f"{label}/", size=9, weight="bold", color=colour, zorder=4)
        for line in _lines(labels, width - column):
            for offset, label in line:
                _draw_label(axes, x + column + 1.6 + offset, y, label, colour)
            y += LINE
        y += BETWEEN


def _draw_label(axes: Axes, x: float, y: float, label: str, colour: str) -> None:
    width, height = _label_width(label), LINE - 0.75
    style = "round,pad=0,rounding_size=0.5"
    axes.add_patch(
        FancyBboxPatch((x, y), width, height, style, fc="white", ec=colour, lw=0.6, zorder=4)
    )
    axes.text(
        x + width / 2,
        y + 0.66 * height,
        label,
        size=8,
        family="monospace",
        color=INK,
        ha="center",
        zorder=5,
    )


def _draw_arrows(axes: Axes, boxes: dict[str, Box], arrows: Counter, right: bool) -> None:
    edge, sign = (RIGHT, 1.0) if right else (LEFT, -1.0)
    chosen = {pair: count for pair, count in arrows.items() if _side(pair) == right}
    sources = sorted({source for source, _ in chosen}, key=ROOMS.index)
    for target in {target for _, target in chosen}:
        takers = _takers(arrows, target, right)
        box = boxes[target]
        gap = min(3.0, box.height / (len(takers) + 1.0))
        middle = box.y + box.height / 2 + gap / 2
        for i, source in enumerate(takers):
            # The outermost lane comes in at the top: nobody's arrow lies on another's.
            end = middle + gap * (i - (len(takers) - 1) / 2)
            lane = edge + sign * (FIRST_LANE + LANE * sources.index(source))
            _draw_arrow(axes, edge, lane, boxes[source], end, chosen[source, target], source)


def _draw_arrow(
    axes: Axes, edge: float, lane: float, source: Box, end: float, count: int, name: str
) -> None:
    """Out at the top of a room, down its lane, and in with a head and a number."""
    start, colour, sign = source.y + 1.1, LOOKS[name][1], 1.0 if lane > edge else -1.0
    assert end > start, f"an import of {name} points up"
    bend, head, half = 0.9, 1.0, 0.34 + 0.01 * count
    points = [
        (edge, start),
        (lane - sign * bend, start),
        (lane, start),
        (lane, start + bend),
        (lane, end - bend),
        (lane, end),
        (lane - sign * bend, end),
        (edge + sign * head, end),
    ]
    codes = [
        Curve.MOVETO,
        Curve.LINETO,
        *[Curve.CURVE3] * 2,
        Curve.LINETO,
        *[Curve.CURVE3] * 2,
        Curve.LINETO,
    ]
    width = 0.8 + 0.15 * count
    axes.add_patch(PathPatch(Curve(points, codes), fc="none", ec=colour, lw=width, zorder=1))
    tip = [(edge, end), (edge + sign * head, end - half), (edge + sign * head, end + half)]
    axes.add_patch(Polygon(tip, fc=colour, ec="none", zorder=2))
    axes.text(
        edge + sign * 1.3,
        end - 0.3 - 0.01 * count,
        str(count),
        size=6.5,
        color=colour,
        weight="bold",
        ha="left" if sign > 0 else "right",
        zorder=2,
    )


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
    print(f"{sys.argv[1]} is drawn")
