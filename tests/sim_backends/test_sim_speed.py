"""Test that the speed measurements are consistent; the benchmark checks the limits."""

import numpy as np
import pytest
import torch

from sim_backends.speed import copy_bandwidth_bytes_per_s, gradient_speed, simulation_speed


def test_simulation_speed_is_consistent_and_far_above_the_loop():
    threads = torch.get_num_threads()
    found = simulation_speed(cars=2048, repeats=2, plain_cars=2)
    assert torch.get_num_threads() == threads
    fast, plain = found["batched_2048_cars_car_steps_per_s"], found["plain_numpy_loop_car_steps_per_s"]
    assert found["ratio_to_plain_numpy_loop"] == pytest.approx(fast / plain)
    # Only the order of magnitude is asserted, because the machine is shared.
    assert found["ratio_to_plain_numpy_loop"] > 50
    assert found["needed_share_of_copy_bandwidth"] < 1
    assert all(np.isfinite(v) and v > 0 for v in found.values())


def test_gradient_speed_counts_each_number():
    found = gradient_speed(cars=1024, repeats=1, batch=2048)
    assert found["numbers"] == 6 + 60 + 13
    assert found["ratio"] > 2
    assert found["ratio"] == pytest.approx(found["central_differences_s"] / found["gradient_s"])


def test_copy_bandwidth_is_that_of_a_memory():
    assert 1e8 < copy_bandwidth_bytes_per_s(16, 2) < 1e13
