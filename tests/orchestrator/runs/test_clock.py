"""The time of a driver while the clock of its machine is set, or the machine sleeps."""

from panolog.orchestrator.runs.clock import Steady


class Machine:
    def __init__(self) -> None:
        self.wall, self.passed, self.slept = 1e9, 50.0, 0.0

    def time(self) -> float:
        return self.wall

    def monotonic(self) -> float:
        return self.passed

    def sleep(self, seconds: float) -> None:
        self.slept += seconds

    def work(self, seconds: float) -> None:
        self.wall, self.passed = self.wall + seconds, self.passed + seconds


def test_a_jump_is_no_time() -> None:
    machine = Machine()
    steady = Steady(machine)
    machine.work(10.0)
    assert steady.time() == 1e9 + 10
    for jump in (86_400.0, -86_400.0, -1e9):  # to and fro, then for good
        machine.wall += jump
        machine.work(5.0)
    assert steady.time() == 1e9 + 25
    assert steady.monotonic() == 75.0
    assert Steady(machine).time() == machine.wall  # the next driver's


def test_what_keeps_a_clock_right_is_followed() -> None:
    machine = Machine()
    steady = Steady(machine)
    machine.wall += 0.5
    machine.work(10.0)
    assert steady.time() == 1e9 + 10.5
    steady.sleep(3.0)
    assert machine.slept == 3.0
