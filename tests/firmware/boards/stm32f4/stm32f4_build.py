"""The Nucleo's and the Black Pill's images in an emulated processor."""

from firmware_build import board_image
from stm32f4_emulator import Emulator
from stm32f4_registers import BLACK_PILL, NUCLEO

BOARDS = {"stm32f4": NUCLEO, "blackpill": BLACK_PILL}
COMPILERS = ("zig", "gcc")


def fresh(compiler: str, board: str = "stm32f4") -> Emulator:
    """Return an emulated board with its image in it, before its reset."""
    return Emulator(board_image(board, compiler), BOARDS[board])
