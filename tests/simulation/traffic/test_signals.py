"""Lights."""

import numpy as np

from torchcover.simulation.traffic.flow import CROSS, MAIN, Signals

TIMES_S = np.arange(0.0, 400.0, 0.05)


def test_green_is_exclusive_and_clearing_times_lie_between():
    signals = Signals(np.array([0.0, 17.3, -211.0]))
    left = np.stack([signals.green_left_s(time) for time in TIMES_S])
    green = left > 0
    assert not (green[..., MAIN] & green[..., CROSS]).any()
    assert green[..., MAIN].any()
    for junction in range(3):
        for phase in (MAIN, CROSS):
            ends = TIMES_S[1:][green[:-1, junction, phase] & ~green[1:, junction, phase]]
            starts = TIMES_S[1:][~green[:-1, junction, 1 - phase] & green[1:, junction, 1 - phase]]
            waits = [(starts[starts > end] - end).min() for end in ends if (starts > end).any()]
            assert len(waits) > 3
            np.testing.assert_allclose(waits, signals.amber_s + signals.clear_s, atol=0.11)


def test_the_green_left_counts_down_to_the_change():
    signals = Signals(np.zeros(1), green_s=(20.0, 10.0), amber_s=3.0, clear_s=2.0)
    assert signals.cycle_s == 40.0
    np.testing.assert_allclose(signals.green_left_s(0.0)[0], [20.0, -np.inf])
    np.testing.assert_allclose(signals.green_left_s(19.0)[0, MAIN], 1.0)
    assert (signals.green_left_s(24.9)[0] < 0).all()
    np.testing.assert_allclose(signals.green_left_s(25.0)[0, CROSS], 10.0)
    np.testing.assert_allclose(signals.green_left_s(34.0 + 5 * 40.0)[0, CROSS], 1.0)


def test_an_offset_moves_the_cycle():
    np.testing.assert_allclose(Signals(np.array([12.0])).green_left_s(5.0), Signals(np.array([0.0])).green_left_s(17.0))
