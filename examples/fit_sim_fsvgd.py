"""Fit Sim-FSVGD (functional SVGD with a simulator as prior) to your own arrays. Takes ten seconds.

Replace ``simulator`` and the data by your own. ``natural=False`` is the update of the paper (arXiv 2403.16644); the
default preconditions it.
"""

import argparse
import math

import torch
from torch import Tensor

from learning.functional_svgd.fsvgd import FsvgdSettings, SimulatorPrior, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.priors.function_prior import RbfCovariance


def simulator(inputs: Tensor, gain: Tensor) -> Tensor:
    """Outputs (P, N, 1) of P simulators with gains (P,) at inputs (N, 1)."""
    return gain[:, None, None] * torch.sin(inputs)


def main() -> None:
    """Fit ten rows of a system that the simulator does not describe exactly, and print predictions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3000, help="steps of the optimiser")
    options = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    inputs = 4.0 * torch.rand(10, 1, generator=generator) - 2.0  # rows (n, D), raw units
    outputs = 1.2 * torch.sin(inputs) + 0.1 * inputs + 0.05 * torch.randn(10, 1, generator=generator)  # (n, O)

    domain = torch.linspace(-math.pi, math.pi, 100)[:, None]  # where the prior holds (M, D)
    unit = torch.ones(1)
    normaliser = Normaliser(0.0 * unit, 2.0 * unit, 0.0 * unit, unit)  # centre and scale of inputs and outputs

    at = torch.cat([inputs, domain])
    gains = 0.5 + torch.rand(64, generator=generator)  # the prior of the parameter: uniform from 0.5 to 1.5
    draws = normaliser.outputs(simulator(at, gains))
    discrepancy = RbfCovariance(scales=(0.2,), lengthscales=(1.0,))  # in units of ``normaliser``
    prior = SimulatorPrior(draws, normaliser.inputs(at), discrepancy)

    settings = FsvgdSettings(steps=options.steps, natural=False)
    posterior = fit_fsvgd(inputs, outputs, domain, prior, normaliser, settings)
    new = torch.tensor([[-3.0], [-1.0], [0.5], [3.0]])
    prediction = posterior.predict(new)
    for x, mean, std in zip(new[:, 0], prediction.mean[:, 0], prediction.std[:, 0], strict=True):
        true = 1.2 * math.sin(x) + 0.1 * x
        print(f"x {x:+.1f}: predicted {mean:+.2f} with standard deviation {std:.2f}, true {true:+.2f}")


if __name__ == "__main__":
    main()
