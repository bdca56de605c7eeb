"""Grid worlds as scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from PIL import Image, ImageDraw
from rich.text import Text

from hdrqn_torchrl.envs.grid.cells import AGENT_COLOUR, FIRST_GOAL, FLOOR, OBSTACLE, WALL, palette
from hdrqn_torchrl.envs.grid.rules import GridRules, GridState
from hdrqn_torchrl.envs.scene import Colour, font

_UNSEEN = (150, 150, 150)  # what lies outside the view fades into this
_LINE = (226, 226, 226)  # between cells
_MARKS = {FLOOR: "·", WALL: "█", OBSTACLE: "x"}  # in a terminal
_ARROWHEADS = (  # up, down, left, right; corners as shares of the agent's disc
    ((-0.55, 0.3), (0.55, 0.3), (0.0, -0.6)),
    ((-0.55, -0.3), (0.55, -0.3), (0.0, 0.6)),
    ((0.3, -0.55), (0.3, 0.55), (-0.6, 0.0)),
    ((-0.3, -0.55), (-0.3, 0.55), (0.6, 0.0)),
)


@dataclass(frozen=True, eq=False)  # tensors have no single answer to ==
class GridScene:
    """One world of :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv` at one moment."""

    rules: GridRules
    state: GridState
    subgoal: int | None
    action: int | None

    action_names = ("↑ up", "↓ down", "← left", "→ right")
    hazard = "obstacle hit"

    @property
    def subgoal_names(self) -> tuple[str, ...]:
        """``goal 1`` is the first to be reached."""
        return tuple(f"goal {index + 1}" for index in range(self.rules.num_goals))

    @property
    def subgoal_colours(self) -> tuple[Colour, ...]:
        """As in the agent's image."""
        return tuple(_colours(self.rules.num_codes)[FIRST_GOAL:])

    def outcome(self, success: bool, terminated: bool) -> str:
        """How an episode ended."""
        if not terminated:
            return "time is up"
        if not success:
            return "all goals, but not in order"
        goals = self.rules.num_goals
        return {1: "goal reached", 2: "both goals in order"}.get(goals, f"all {goals} goals in order")

    def draw_world(self, size: int) -> Image.Image:
        """The whole map; what the agent does not see is faded, its view is outlined."""
        pixels = size // max(self.rules.height, self.rules.width)
        image = draw_cells(self._map(), pixels, seen=self._seen())
        self._draw_window(ImageDraw.Draw(image), pixels)
        row, column = divmod(int(self.state.agent), self.rules.width)
        self._draw_marks(image, self._map(), row, column, pixels)
        return image

    def draw_view(self, size: int) -> Image.Image:
        """The observation, agent in the centre."""
        centre, pixels = self.rules.view // 2, size // self.rules.view
        image = draw_cells(self._observation(), pixels)
        self._draw_marks(image, self._observation(), centre, centre, pixels)
        return image

    def write_world(self) -> Text:
        """The map with dots where the agent sees free floor, ``@`` for the agent and ``>`` before its subgoal."""
        return self._write(self._map(), divmod(int(self.state.agent), self.rules.width), self._seen())

    def write_view(self) -> Text:
        """The observation."""
        return self._write(self._observation(), (self.rules.view // 2,) * 2)

    def _map(self) -> list[list[int]]:
        return self.rules.whole_map(self.state)[0].tolist()

    def _observation(self) -> list[list[int]]:
        return self.rules.observe(self.state)[0].tolist()

    def _seen(self) -> list[list[bool]]:
        cells, width = set(self.rules.window_cells[self.state.agent].flatten().tolist()), self.rules.width
        return [[row * width + column in cells for column in range(width)] for row in range(self.rules.height)]

    def _draw_window(self, draw: ImageDraw.ImageDraw, pixels: int) -> None:
        """Outline of the agent's view, as far as it lies on the map."""
        cells = self.rules.window_cells[self.state.agent].flatten()
        cells = cells[cells != self.rules.nowhere]
        rows, columns = cells // self.rules.width, cells % self.rules.width
        corners = int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1
        left, top, right, bottom = (corner * pixels for corner in corners)
        draw.rectangle((left, top, right - 1, bottom - 1), outline=AGENT_COLOUR, width=2)

    def _draw_marks(self, image: Image.Image, codes: list[list[int]], row: int, column: int, pixels: int) -> None:
        """The ring around the subgoal, and the agent with the direction that it is about to take."""
        if self.subgoal is not None:
            for place in _places(codes, FIRST_GOAL + self.subgoal):
                _ring(image, *place, pixels, self.subgoal_colours[self.subgoal])
        draw = ImageDraw.Draw(image)
        x, y, radius = (column + 0.5) * pixels, (row + 0.5) * pixels, 0.38 * pixels
        _disc(draw, x, y, radius, AGENT_COLOUR)
        if self.action is not None:
            corners = [(x + radius * right, y + radius * down) for right, down in _ARROWHEADS[self.action]]
            draw.polygon(corners, fill=(255, 255, 255))

    def _write(self, codes: list[list[int]], agent: tuple[int, int], seen: list[list[bool]] | None = None) -> Text:
        """Two characters a cell: a mark before the subgoal, then what stands there."""
        text, colours = Text(), _colours(self.rules.num_codes)
        for row, line in enumerate(codes):
            for column, code in enumerate(line):
                visible = seen is None or seen[row][column]
                sign = _MARKS.get(code, str(code - FIRST_GOAL + 1))
                if (row, column) == agent:
                    sign = " @"
                elif code == WALL:
                    sign *= 2
                elif code == FLOOR:
                    sign = f" {sign}" if visible else "  "
                else:
                    wanted = self.subgoal is not None and code == FIRST_GOAL + self.subgoal
                    sign = f"{'>' if wanted else ' '}{sign}"
                text.append(sign, _style(code, (row, column) == agent, visible, colours))
            text.append("\n" if row + 1 < len(codes) else "")
        return text


def _style(code: int, is_agent: bool, visible: bool, colours: Sequence[Colour]) -> str:
    if is_agent:
        return "bold reverse"
    if code in (FLOOR, WALL):
        return "bright_black"
    return f"{'bold' if visible else 'dim'} #{''.join(f'{part:02x}' for part in colours[code])}"


def draw_cells(codes: list[list[int]], pixels: int, *, seen: list[list[bool]] | None = None) -> Image.Image:
    """Cell codes as coloured squares: goals carry their number, obstacles a cross.

    Args:
        codes: rows of cell codes.
        pixels: side of a cell.
        seen: cells that are not faded; ``None``: all of them.
    """
    image = Image.new("RGB", (len(codes[0]) * pixels, len(codes) * pixels))
    draw = ImageDraw.Draw(image)
    colours = _colours(max(FIRST_GOAL, *(max(row) + 1 for row in codes)))
    for row, line in enumerate(codes):
        for column, code in enumerate(line):
            faded = seen is not None and not seen[row][column]
            _draw_cell(draw, column * pixels, row * pixels, pixels, code, colours[code], faded)
    return image


def _draw_cell(
    draw: ImageDraw.ImageDraw, left: int, top: int, pixels: int, code: int, colour: Colour, faded: bool
) -> None:
    fill, line, white = (_faded(each) if faded else each for each in (colour, _LINE, (255, 255, 255)))
    draw.rectangle((left, top, left + pixels - 1, top + pixels - 1), fill=fill, outline=line if code == FLOOR else fill)
    middle = left + pixels / 2, top + pixels / 2
    if code == OBSTACLE:
        near, far = 0.28 * pixels, 0.72 * pixels
        for start, end in ((near, far), (far, near)):
            points = (left + start, top + near, left + end, top + far)
            draw.line(points, fill=white, width=max(1, pixels // 10))
    elif code >= FIRST_GOAL:
        draw.text(middle, str(code - FIRST_GOAL + 1), white, font(round(0.6 * pixels), bold=True), anchor="mm")


def _ring(image: Image.Image, row: int, column: int, pixels: int, colour: Colour) -> None:
    """A frame around a cell that reaches a little into its neighbours, as far as there are any."""
    draw, width = ImageDraw.Draw(image), max(2, pixels // 9)
    left, top = max(0, column * pixels - 2 * width), max(0, row * pixels - 2 * width)
    right = min(image.width, (column + 1) * pixels + 2 * width) - 1
    bottom = min(image.height, (row + 1) * pixels + 2 * width) - 1
    draw.rectangle((left, top, right, bottom), outline=colour, width=width)
    inner = left + width, top + width, right - width, bottom - width
    draw.rectangle(inner, outline=(255, 255, 255), width=width)


def _disc(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, colour: Colour) -> None:
    draw.ellipse((x - radius, y - radius, x + radius - 1, y + radius - 1), fill=colour)


def _places(codes: list[list[int]], code: int) -> list[tuple[int, int]]:
    return [(row, column) for row, line in enumerate(codes) for column, found in enumerate(line) if found == code]


def _faded(colour: Colour) -> Colour:
    red, green, blue = ((part + grey) // 2 for part, grey in zip(colour, _UNSEEN, strict=True))
    return red, green, blue


@cache
def _colours(num_codes: int) -> list[Colour]:
    return [(red, green, blue) for red, green, blue in palette(num_codes).tolist()]
