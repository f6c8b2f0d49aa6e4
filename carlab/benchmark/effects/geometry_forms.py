"""Axles at other distances from the centre of mass than in the car file, and motion capture with a wrong scale."""

from __future__ import annotations

import dataclasses

import numpy as np

from carlab.benchmark.effects.catalogue import Form, Parameters, signed
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import FloatArray


def other_wheelbase(world: World, p: Parameters) -> None:
    """Both axle distances are scaled."""
    front_m, rear_m = (1.0 + p["change"]) * world.car.front_axle, (1.0 + p["change"]) * world.car.rear_axle
    world.car = dataclasses.replace(world.car, front_axle=front_m, rear_axle=rear_m)


def scaled_motion_capture(world: World, p: Parameters) -> None:
    """Motion capture measures distances too large or too small, as after a calibration with a wrong wand."""
    scale = np.array([1.0 + p["change"], 1.0 + p["change"], 1.0])

    def stretch(t: FloatArray, pose: FloatArray) -> FloatArray:
        return np.asarray(pose * scale, dtype=np.float64)

    world.pose_changes.append(stretch)


def moved_centre_of_mass(world: World, p: Parameters) -> None:
    """The centre of mass, which is tracked, lies elsewhere between the axles."""
    front_m, rear_m = world.car.front_axle - p["ahead"], world.car.rear_axle + p["ahead"]
    world.car = dataclasses.replace(world.car, front_axle=front_m, rear_axle=rear_m)


FORMS = (
    Form("wheelbase", "catalogue", signed("change"), other_wheelbase, 0.01, 0.3, changes_car=True),
    Form("wheelbase", "other", signed("change"), scaled_motion_capture, 0.01, 0.3),
    Form("centre_of_mass", "catalogue", signed("ahead"), moved_centre_of_mass, 0.003, 0.08, changes_car=True),
)
