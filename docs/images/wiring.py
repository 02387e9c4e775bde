"""Draw wiring.svg and wiring.png: how the Nucleo-F446RE is wired to one joint, the supply and the emergency stop.

    python docs/images/wiring.py        (needs matplotlib)

The pins are those of firmware/boards/stm32f4/pins.c; docs/howto/nucleo.md has them as a table, which a test
holds to the code.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle

matplotlib.rcParams["svg.fonttype"] = "path"  # the same letters wherever it is looked at
matplotlib.rcParams["svg.hashsalt"] = "armsight"  # and the same file whenever it is drawn
INK, MOTOR, LOGIC, SENSE, STOP = "#1b1f24", "#b4451f", "#1f5fb4", "#2a7d3f", "#8a1c5c"
PAPER, BOARD = "#ffffff", "#eef3fa"
JOINTS = (
    ("1", "PC0  CN7-38", "PA8  CN10-23", "PB2  CN10-22", "PA0  CN7-28"),
    ("2", "PC1  CN7-36", "PA9  CN10-21", "PB14 CN10-28", "PA1  CN7-30"),
    ("3", "PC2  CN7-35", "PA10 CN10-33", "PB15 CN10-26", "PA4  CN7-32"),
    ("4", "PC3  CN7-37", "PC6  CN10-4", "PB8  CN10-3", "PA7  CN10-15"),
    ("5", "PC4  CN10-34", "PC7  CN10-19", "PB9  CN10-5", "PB0  CN7-34"),
    ("6", "PC5  CN10-6", "PC8  CN10-2", "PB10 CN10-25", "PB1  CN10-24"),
)


class Sheet:
    """A sheet of paper, 180 x 116, with the few symbols a wiring needs."""

    def __init__(self) -> None:
        self.figure = Figure(figsize=(18, 11.6), facecolor=PAPER)
        self.axes: Axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set(xlim=(0, 180), ylim=(0, 116))
        self.axes.axis("off")

    def wire(self, *points: tuple[float, float], color: str = INK, width: float = 1.6) -> None:
        """Draw a wire along points."""
        self.axes.plot([p[0] for p in points], [p[1] for p in points], color=color, lw=width, solid_joinstyle="miter")

    def dot(self, x: float, y: float, color: str = INK) -> None:
        """Join wires."""
        self.axes.add_patch(Circle((x, y), 0.55, color=color, zorder=3))

    def text(self, x: float, y: float, said: str, *, size: float = 10, color: str = INK, **how: str) -> None:
        """Write."""
        self.axes.text(x, y, said, fontsize=size, color=color, **({"ha": "left", "va": "center"} | how))

    def box(self, x: float, y: float, width: float, height: float, fill: str = PAPER) -> None:
        """Draw a device."""
        shape = FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=1.2")
        shape.set(facecolor=fill, edgecolor=INK, linewidth=1.6)
        self.axes.add_patch(shape)

    def resistor(self, x: float, y: float, said: str, *, upright: bool = False, right: bool = True) -> None:
        """Draw a resistor of length 6 centred on a point."""
        width, height = (2.2, 6.0) if upright else (6.0, 2.2)
        corner = (x - width / 2, y - height / 2)
        self.axes.add_patch(Rectangle(corner, width, height, facecolor=PAPER, edgecolor=INK, lw=1.6, zorder=3))
        if upright:
            self.text(x + (2.0 if right else -2.0), y, said, size=9, ha="left" if right else "right")
        else:
            self.text(x, y + 2.6, said, size=9, ha="center")

    def capacitor(self, x: float, y: float, said: str) -> None:
        """Draw a capacitor to ground, hanging from a point."""
        self.wire((x, y), (x, y - 2.6))
        for at in (y - 2.6, y - 3.6):
            self.wire((x - 1.8, at), (x + 1.8, at), width=2.2)
        self.wire((x, y - 3.6), (x, y - 6.0))
        self.ground(x, y - 6.0)
        self.text(x + 2.2, y - 3.1, said, size=9)

    def ground(self, x: float, y: float) -> None:
        """Draw a ground symbol below a point."""
        for i, half in enumerate((1.8, 1.1, 0.4)):
            self.wire((x - half, y - 0.8 * i), (x + half, y - 0.8 * i))

    def rail(self, x: float, y: float, said: str, color: str = INK) -> None:
        """Draw a supply's bar above a point."""
        self.wire((x - 1.8, y), (x + 1.8, y), color=color, width=2.4)
        self.text(x, y + 1.7, said, size=9, color=color, ha="center")

    def contact(self, x: float, y: float, said: str, color: str) -> None:
        """Draw a normally closed contact of width 8 from a point to the right."""
        self.wire((x, y), (x + 1.5, y), color=color)
        self.wire((x + 1.5, y), (x + 6.8, y + 0.5), color=color, width=2.4)
        self.wire((x + 6.4, y), (x + 6.4, y + 1.3), color=color)
        self.wire((x + 6.4, y), (x + 8, y), color=color)
        self.text(x + 4, y + 3.0, said, size=9, color=color, ha="center")


def draw_board(sheet: Sheet) -> None:
    """The Nucleo, with the pins of all joints inside."""
    sheet.box(60, 30, 60, 56, BOARD)
    sheet.text(90, 82.5, "Nucleo-F446RE", size=15, ha="center", weight="bold")
    sheet.text(90, 79.3, "STM32F446RE, 180 MHz", size=10, ha="center")
    columns = (73.5, 83.0, 93.5, 104.0)
    sheet.text(66.5, 75, "joint", size=9, ha="center", weight="bold")
    for x, said, color in zip(columns, ("pot", "PWM", "DIR", "CS"), (SENSE, LOGIC, LOGIC, SENSE), strict=True):
        sheet.text(x, 75, said, size=9, ha="left", color=color, weight="bold")
    for row, (joint, *pins) in enumerate(JOINTS):
        y = 72 - 2.6 * row
        sheet.text(66.5, y, joint, size=8.5, ha="center")
        for x, pin in zip(columns, pins, strict=True):
            sheet.text(x, y, pin, size=7.6, family="monospace")
    for y, said, color in ((52, "pot 1: PC0", SENSE), (47, "AVDD  CN10-7", INK), (42, "AGND  CN10-32", INK)):
        sheet.text(61.5, y, said, size=9.5, color=color)
    sheet.text(61.5, 35, "supply: PA5  CN10-11", size=9.5, color=SENSE)
    right = (
        (54.5, "PWM 1: PA8", LOGIC),
        (50.5, "DIR 1: PB2", LOGIC),
        (46.5, "enable: PC9  CN10-1", LOGIC),
        (42.5, "CS 1: PA0", SENSE),
        (37, "stop: PA6  CN10-13", STOP),
        (33, "stop: PB12  CN10-16", STOP),
    )
    for y, said, color in right:
        sheet.text(118.5, y, said, size=9.5, color=color, ha="right")
    sheet.box(84, 86, 12, 4, BOARD)
    sheet.text(90, 88, "ST-Link", size=9, ha="center")
    sheet.wire((90, 90), (90, 99), (73, 99), color=LOGIC, width=3)
    sheet.box(50, 95, 23, 8)
    sheet.text(61.5, 100.3, "host", size=12, ha="center", weight="bold")
    sheet.text(61.5, 97.4, "USB: 921600 baud, flashing", size=8.5, ha="center")


def draw_pot(sheet: Sheet) -> None:
    """One potentiometer: pull-up against an open wiper, series resistor, capacitor at the pin."""
    sheet.text(5, 73, "Potentiometer, six times", size=12, weight="bold", color=SENSE)
    sheet.wire((14, 66), (14, 42), color=INK)
    sheet.rail(14, 66, "AVDD (3.3 V)")
    sheet.resistor(14, 57, "", upright=True)
    sheet.text(4, 57, "pot 1\n1 to 10 kΩ\nlinear", size=9)
    sheet.wire((14, 42), (60, 42))
    sheet.wire((14, 47), (14, 42))
    sheet.wire((22, 57), (16.2, 57), color=SENSE)
    sheet.axes.add_patch(Polygon([(15.2, 57), (17.4, 58), (17.4, 56)], color=SENSE, zorder=4))
    sheet.wire((22, 57), (48, 57), (48, 52), (60, 52), color=SENSE)
    sheet.wire((26, 57), (26, 66))
    sheet.rail(26, 66, "AVDD")
    sheet.resistor(26, 61.8, "100 kΩ", upright=True)
    sheet.dot(26, 57, SENSE)
    sheet.resistor(37, 57, "1 kΩ")
    sheet.dot(48, 52, SENSE)
    sheet.capacitor(48, 52, "10 nF")
    sheet.wire((60, 47), (55, 47), (55, 66))
    sheet.rail(55, 66, "AVDD")


def draw_bridge(sheet: Sheet) -> None:
    """One bridge with its motor."""
    sheet.text(153.5, 67.5, "H-bridge, six times", size=12, weight="bold", color=MOTOR)
    sheet.box(140, 36, 22, 26)
    sheet.text(151, 59, "bridge 1", size=10.5, ha="center", weight="bold")
    sheet.text(151, 38.2, "DRV8874: PMODE low", size=8, ha="center")
    names = ((54.5, "EN (PWM)", LOGIC), (50.5, "PH (DIR)", LOGIC), (46.5, "SLP", LOGIC), (42.5, "CS", SENSE))
    for y, said, color in names:
        sheet.wire((120, y), (140, y), color=color)
        sheet.text(141, y, said, size=9, color=color)
    sheet.dot(133, 46.5, LOGIC)
    sheet.wire((133, 46.5), (133, 30))
    sheet.resistor(133, 26.5, "10 kΩ", upright=True)
    sheet.wire((133, 23.5), (133, 21.5))
    sheet.ground(133, 21.5)
    sheet.text(122, 48.0, "to all six", size=8, color=LOGIC)
    sheet.axes.add_patch(Circle((171, 49), 4, facecolor=PAPER, edgecolor=MOTOR, lw=2))
    sheet.text(171, 49, "M1", size=11, ha="center", color=MOTOR, weight="bold")
    sheet.wire((162, 54), (171, 54), (171, 53), color=MOTOR, width=2.4)
    sheet.wire((162, 44), (171, 44), (171, 45), color=MOTOR, width=2.4)
    sheet.text(161, 54, "OUT1", size=9, ha="right")
    sheet.text(161, 44, "OUT2", size=9, ha="right")
    sheet.wire((151, 62), (151, 96), color=MOTOR, width=2.6)
    sheet.text(152, 63.6, "VM", size=9, color=MOTOR)
    sheet.wire((151, 36), (151, 33))
    sheet.ground(151, 33)


def draw_supply(sheet: Sheet) -> None:
    """Motor supply: fuse, relay contact, capacitor, and the divider that measures it."""
    sheet.text(100, 112, "Motor supply, cut by the emergency stop", size=12, weight="bold", color=MOTOR)
    sheet.box(100, 92, 14, 8)
    sheet.text(107, 96, "12 V", size=12, ha="center", weight="bold")
    sheet.wire((114, 96), (130, 96), color=MOTOR, width=2.6)
    sheet.axes.add_patch(Rectangle((118, 94.9), 6, 2.2, facecolor=PAPER, edgecolor=MOTOR, lw=1.8, zorder=3))
    sheet.text(121, 98.8, "fuse", size=9, ha="center")
    sheet.wire((130, 96), (131.5, 96), (136.5, 98.4), color=MOTOR, width=2.6)
    sheet.wire((137, 96), (174, 96), color=MOTOR, width=2.6)
    sheet.text(134, 101, "relay K1\n(open without power)", size=9, ha="center", color=STOP)
    sheet.dot(151, 96, MOTOR)
    sheet.text(163, 98, "VM: to all six bridges", size=9, color=MOTOR, ha="center")
    sheet.dot(167, 96, MOTOR)
    sheet.capacitor(167, 96, "1000 µF\n35 V")
    sheet.dot(141, 96, MOTOR)
    sheet.wire((141, 96), (141, 74), color=MOTOR)
    sheet.resistor(141, 85, "20 kΩ", upright=True)
    sheet.wire((141, 74), (141, 70))
    sheet.resistor(141, 72.5, "1 kΩ", upright=True)
    sheet.ground(141, 68.3)
    sheet.wire((141, 69.5), (141, 68.3))
    sheet.dot(141, 78, SENSE)
    sheet.wire((141, 78), (127, 78), color=SENSE)
    sheet.capacitor(131, 78, "100 nF")
    sheet.dot(131, 78, SENSE)
    sheet.text(126.5, 78, "to PA5", size=9.5, color=SENSE, ha="right")
    sheet.wire((60, 35), (52, 35), color=SENSE)
    sheet.text(51, 35, "from the divider", size=9.5, color=SENSE, ha="right")


def draw_stop(sheet: Sheet) -> None:
    """The emergency stop: one contact for the motors' power, one the firmware and the timers see."""
    sheet.text(5, 26, "Emergency stop: one button, two normally closed contacts", size=12, weight="bold", color=STOP)
    sheet.rail(8, 20, "12 V")
    sheet.wire((8, 20), (8, 17), (20, 17), color=STOP)
    sheet.contact(20, 17, "contact A", STOP)
    sheet.wire((28, 17), (38, 17), color=STOP)
    sheet.box(38, 14.5, 12, 5)
    sheet.text(44, 17, "coil K1", size=9.5, ha="center")
    sheet.text(44, 12.6, "with its diode", size=8.5, ha="center")
    sheet.wire((50, 17), (54, 17), (54, 15))
    sheet.ground(54, 15)
    sheet.ground(14, 3.4)
    sheet.wire((14, 3.4), (14, 6), (20, 6), color=STOP)
    sheet.contact(20, 6, "contact B", STOP)
    sheet.wire((28, 6), (126, 6), (126, 37), (120, 37), color=STOP)
    sheet.wire((120, 33), (126, 33), color=STOP)
    sheet.dot(126, 33, STOP)
    sheet.wire((24, 16.2), (24, 8.5), color=STOP, width=0.8)
    sheet.resistor(66, 6, "470 Ω")
    sheet.dot(84, 6, STOP)
    sheet.wire((84, 6), (84, 16), color=INK)
    sheet.resistor(84, 12, "4.7 kΩ", upright=True)
    sheet.rail(84, 17, "3.3 V  CN7-16")
    sheet.wire((104, 6), (104, 9))
    sheet.dot(104, 6, STOP)
    for at in (9.0, 10.0):
        sheet.wire((102.2, at), (105.8, at), width=2.2)
    sheet.wire((104, 10), (104, 12.6))
    sheet.wire((104, 12.6), (108, 12.6), (108, 11.6))
    sheet.ground(108, 11.6)
    sheet.text(99, 9.5, "100 nF", size=9, ha="center")
    said = (
        "high = stop: a pressed button",
        "and a cut wire are the same.",
        "PA6 and PB12 break TIM8 and TIM1:",
        "the PWM falls without the",
        "processor's help.",
    )
    sheet.text(138, 10, "\n".join(said), size=10, color=STOP)


def main() -> None:
    """Draw both files beside this script."""
    sheet = Sheet()
    for draw in (draw_board, draw_pot, draw_bridge, draw_supply, draw_stop):
        draw(sheet)
    sheet.text(5, 111, "armsight: six joints on a Nucleo-F446RE", size=16, weight="bold")
    sheet.text(5, 107, "Joint 1 is drawn; the other five are alike. Not tried on hardware.", size=10)
    sheet.text(5, 103.6, "All grounds meet at the motor supply's minus.", size=10)
    here = Path(__file__).parent
    sheet.figure.savefig(here / "wiring.svg", metadata={"Date": None})
    sheet.figure.savefig(here / "wiring.png", dpi=110)


if __name__ == "__main__":
    main()
