"""Train a policy with your settings in the learned car, then drive it. Takes three minutes; ``--updates 200`` one.

``carlab.learn`` saves the learned car of each episode in the run's folder. ``ModelEnv`` simulates copies of it as an
environment of Stable-Baselines3; this example trains a SAC agent with wider layers in it.
"""

import argparse
from pathlib import Path

import carlab
from carlab.core.task import ParkingTask
from carlab.experiment.campaign.training import DYNAMICS_FILE, model_folder
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.world.car_fit import load_car
from learning.world.model_env import ModelEnv


def main() -> None:
    """Fit the car to one episode, train a policy in the learned car, and drive."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--updates", type=int, default=20000, help="gradient steps of each policy")
    parser.add_argument("--model-steps", type=int, default=None, help="optimiser steps of the learned car")
    parser.add_argument("--out", type=Path, default=Path("runs"))
    options = parser.parse_args()

    run = carlab.learn(
        "sim", episodes=1, updates=options.updates, model_steps=options.model_steps, rerun=False, out=options.out
    )
    learned_car = load_car(model_folder(run.folder / "models", 1) / DYNAMICS_FILE)
    task = ParkingTask(history_length=learned_car.history)
    settings = SacSettings(hidden=(128, 128), learning_rate=5e-4)
    env = ModelEnv(learned_car, task, settings.cars, seed=1)
    agent = SacAgent(settings, seed=1)
    agent.train(env, options.updates)
    returns, *_ = ModelEnv(learned_car, task, 64, seed=2).roll_out(agent.act)
    print(f"Mean return of the new policy in the learned car: {returns.mean():.1f}")

    drive = carlab.drive("sim", policy=agent.policy(), task=task, out=options.out)
    (episode,) = drive.episodes
    print(f"On the simulated car: {episode.total_reward:.1f}, {episode.summary['distance_m']:.2f} m from the goal")


if __name__ == "__main__":
    main()
