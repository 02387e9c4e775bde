"""The lock-step link: who lets time pass, how fast bytes ride in, what can be made to go wrong."""

import numpy as np
import pytest
from board_rigs import hold, host_board

from armsight.errors import DeviceError, InputError
from armsight.robot.board_registry import configured, open_board
from armsight.robot.boards.board import Board
from armsight.robot.boards.codes import BoardState, Fault
from armsight.robot.boards.emulated import EmulatedLink
from armsight.robot.boards.emulators import EMULATORS, open_emulator
from armsight.robot.boards.frames import ANSWER, ANSWER_MAGIC, REQUEST, REQUEST_MAGIC, VERSION
from armsight.sim.joints import JointPlant


class RecordingEmulator:
    """Keeps the requests and answers each with its tick."""

    def __init__(self, **changed):
        self.requests, self.changed, self.closed = [], changed, False

    def tick(self, request):
        frame = np.frombuffer(request, REQUEST)[0]
        self.requests.append(frame)
        answer = np.zeros((), ANSWER)
        answer["magic"], answer["version"], answer["tick"] = ANSWER_MAGIC, VERSION, frame["tick"]
        for name, value in self.changed.items():
            answer[name] = value
        return answer.tobytes()

    def close(self):
        self.closed = True


def test_requests_carry_what_is_sensed():
    emulator, plant = RecordingEmulator(), JointPlant()
    plant.supply_mv, plant.stop_pressed = 11500, True
    link = EmulatedLink(emulator, plant)
    link.step(2)
    first, second = emulator.requests
    assert (first["magic"], first["version"], first["tick"], second["tick"]) == (REQUEST_MAGIC, VERSION, 1, 2)
    assert (first["supply_mv"], first["stop_pressed"]) == (11500, 1)
    assert np.abs(first["counts"].astype(int) - 32768).max() < 40
    assert link.t_s == pytest.approx(0.002)


@pytest.mark.parametrize("baud", [9600, 115200, 921600])
def test_bytes_ride_in_at_the_baud_rate(baud):
    emulator = RecordingEmulator()
    link = EmulatedLink(emulator, JointPlant(), baud)
    link.step(50)  # what the wire could have carried meanwhile does not add up
    sent = bytes(k % 251 for k in range(700))
    link.write(sent[:400])
    link.write(sent[400:])
    link.step(900)
    lengths = [int(frame["length"]) for frame in emulator.requests[50:]]
    arrived = b"".join(frame["bytes"][: frame["length"]].tobytes() for frame in emulator.requests)
    assert arrived == sent
    ticks = len(sent) / (baud / 10_000)
    last = max(k for k, length in enumerate(lengths) if length) + 1
    assert abs(last - ticks) <= 1
    assert max(lengths) <= np.ceil(baud / 10_000) + 1


def test_wire_faults_stand_between_both_sides():
    class Reverse:
        def to_board(self, tick, data):
            return data[::-1]

        def to_host(self, tick, data):
            return data + bytes([tick])

    emulator = RecordingEmulator(length=2)
    link = EmulatedLink(emulator, JointPlant(), faults=Reverse())
    link.write(b"abc")
    assert link.read(0.002) == b"\0\0\1\0\0\2"
    assert emulator.requests[0]["bytes"][:3].tobytes() == b"cba"


def test_a_world_that_owns_the_time_steps_the_link():
    emulator, asked = RecordingEmulator(), []

    def advance(dt_s):
        asked.append(dt_s)
        for _ in range(round(dt_s * 1000)):
            link.step()

    link = EmulatedLink(emulator, JointPlant(), advance=advance)
    link.read(0.003)
    link.read()
    assert asked == [0.003]
    assert len(emulator.requests) == 3


def test_a_whole_board_runs_in_a_world_that_owns_the_time():
    link = EmulatedLink(open_emulator("host"), JointPlant(), advance=lambda dt_s: link.step(round(dt_s * 1000)))
    board = configured(link)
    board.enable()
    assert board.status.state == BoardState.ENABLED


@pytest.mark.parametrize("changed", [{"magic": 0}, {"version": 1}, {"tick": 9}])
def test_an_answer_of_another_image_is_rejected(changed):
    link = EmulatedLink(RecordingEmulator(**changed), JointPlant())
    with pytest.raises(
        DeviceError, match="did not answer tick 1 with a frame of version 4: its image and this armsight"
    ):
        link.step()


def test_a_closed_link_says_so_and_ends_its_emulator():
    emulator = RecordingEmulator()
    link = EmulatedLink(emulator, JointPlant())
    link.close()
    link.close()
    assert emulator.closed
    for use in (link.read, link.step, lambda: link.write(b"x")):
        with pytest.raises(DeviceError, match="the emulated board is closed"):
            use()


@pytest.mark.parametrize("baud", [0, -1])
def test_a_baud_rate_must_be_one(baud):
    with pytest.raises(InputError, match="baud"):
        EmulatedLink(RecordingEmulator(), JointPlant(), baud)


def test_lost_time_is_reported_by_its_own_fault():
    for spoil, fault in (
        (lambda link: link.miss(3), Fault.TICK_MISSED),
        (lambda link: link.overrun(), Fault.TICK_OVERRUN),
    ):
        board, link, _ = host_board()
        board.enable()
        board.send(hold([0.0] * 6))
        spoil(link)
        board.receive(0.03)
        assert [each.fault for each in board.status.faults] == [fault]
        assert board.status.state == BoardState.HOLDING


def test_missed_time_moves_the_arm_on():
    board, link, plant = host_board()
    board.enable()
    for k in range(40):
        board.send(hold([0.01 * (k + 1)] * 6))
        board.receive(0.01)
    before, duty = plant.q.copy(), link.answer["outputs"]["duty"].copy()
    link.miss(10)
    assert (duty > 0.05).all()
    assert (plant.q > before + 0.002).all()


def test_a_power_cut_switches_the_drives_off():
    board, link, _ = host_board()
    board.enable()
    assert link.answer["outputs"]["drives_on"]
    link.restart()
    link.step()
    assert not link.answer["outputs"]["drives_on"]
    assert Board.connect(link).status.faults == ()


def test_boards_are_opened_by_name():
    board = open_board("emulated:host", JointPlant())
    assert board.status.state == BoardState.DISABLED
    board.close()
    with pytest.raises(InputError, match="no board 'emulated:avr'; there are emulated:unicorn, emulated:qemu"):
        open_board("emulated:avr", JointPlant())
    with pytest.raises(InputError, match=r"no board '/dev/ttyACM0'; .* serial:PORT"):
        open_board("/dev/ttyACM0")
    with pytest.raises(InputError, match="emulated:host needs a plant"):
        open_board("emulated:host")
    with pytest.raises(InputError, match="no emulator 'bochs'; there are unicorn, qemu, host"):
        open_emulator("bochs")
    assert set(EMULATORS) == {"unicorn", "qemu", "host"}
