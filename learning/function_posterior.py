"""What data and simulator together say about a function: the posterior's moments at any inputs.

A function is a simulator with unknown parameters and a Gaussian process for what it leaves out, seen through noise
(Rothfuss et al., arXiv 2403.16644, section 4). Given the parameters all is Gaussian and closed (Rasmussen and Williams
2006, equations 2.23 and 2.24); over draws of the parameters the moments are averaged (law of total covariance). The
score that Sim-FSVGD has at a measurement set with all of the data in it is that of these marginals, without the noise
of minibatches, and with what the data says of the parameters taken from the simulator rather than from the moments of
its prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.domain_models import ABSURD, BROKEN_DOWN, DomainModel, draw_parameters
from learning.evaluation import Mixture
from learning.gap import EXPECTED_GAP, TINY, GapCovariance, learn_gap, learn_noise
from learning.normaliser import Normaliser
from learning.outliers import (
    first_trust,
    joint_surprise,
    left_out,
    left_out_density,
    output_correlation,
    student_weights,
    turn_of,
    typical_scale,
)
from learning.parameter_posterior import posterior_parameters

DRAWS = 128
PRIOR_DRAWS = 1024
PARAMETER_ROWS = 800
"""Rows, drawn from all, by which the parameters are found."""
FIRST_PARAMETER_ROWS = 200
"""The same before the last round, whose parameters only tell where the gap is learned."""
LARGEST = 2000
"""Rows that are conditioned on; of more data so many are drawn."""
JITTER = 1e-5
"""Variance added to a marginal, in normalised outputs."""
DOMAIN_ROWS = 64
"""Of a simulator's domain: where draws of its prior are tried before there is data."""
ROUNDS = 3
"""Of finding covariance, parameters, outliers and the turn of the outputs. Of the first two thirds of train_1 of the
ETH car and its last: 800 rows -21.1 without a turn, -24.24 with two rounds, -24.61 with three; 200 rows -20.3, -23.7
and -23.9."""
LEAST_OF_EXPECTED = 0.01
"""Of the expected noise, what is left at least."""
ROWS_FOR_TAILS = 40
"""Rows from which on outliers are told from noise."""
SHARE_OF_MANY = 0.1
"""From ``ROWS_FOR_TAILS`` on, of the size of a gap: what it is expected to have in proportion to what the simulator
says. Fewer rows hardly tell its parameters, and all that it says may be too large; more of it then learns what is
peculiar to a drive. Of the first two thirds of train_1 of the ETH car and its last: 800 rows -24.59 -> -24.94, 200
-23.94 -> -23.97; race cars in simulation with 20 rows, where 1 stays: -18.5, and -17.4 with this."""
STARTS = (1.0, 0.3, 3.0, 10.0)
"""Of the size that a gap is expected to have, where its covariance is looked for: the evidence has several optima,
and its highest is not the best. Rows that are left out rank them as others do: of race cars in simulation, judged by
training rows of other draws, 50 rows gain 0.12 nats, 100 none, 200 0.08, 400 0.21 (three draws each); of the first two
thirds of train_1 of the ETH car and its last, 200 rows none, 800 0.05 (three and two draws)."""
SURE = 2.0
"""Standard errors by which they must prefer another start than the first."""
ROWS_OF_A_FREEDOM, LEAST_FREEDOM = 8.0, 6.0
"""A covariance that is learned is uncertain itself: predictions have at most one degree of freedom for so many rows, or
the least. By race cars in simulation and training rows: of 20 rows -15.6 -> -18.1, of 100 -22.32 -> -22.40."""
_AT_ONCE = 256


@dataclass(frozen=True, slots=True)
class FunctionPosterior:
    """A simulator, its gap, and data, as Gaussian marginals in normalised outputs.

    Attributes:
        normaliser: of inputs and outputs.
        noise_std: of the measurements (O,).
        freedom: degrees of freedom of their multivariate Student distribution, at most what the rows that chose the
            covariance allow; infinite for a Gaussian.
        correlation: of what is missed in the normalised outputs (O, O), noise and the function's doubt alike.
        model: the simulator; zero where it is None.
        parameters: draws of its parameters given the data (P, K).
        gap: covariance of what it leaves out; nothing where it is None.
        inputs: normalised inputs of the data, and what the simulator says there (n, D + O); (n, D) without one.
        factor: Cholesky factors of the data's covariance (O, n, n).
        white: residuals of each draw, whitened by them (O, n, P).
    """

    normaliser: Normaliser
    noise_std: Tensor
    freedom: float
    correlation: Tensor
    model: DomainModel | None
    parameters: Tensor | None
    gap: GapCovariance | None
    inputs: Tensor
    factor: Tensor
    white: Tensor

    @property
    def data(self) -> Tensor:
        """Raw inputs (n, D) of the data."""
        units = self.normaliser
        return units.raw_inputs(self.inputs[:, : len(units.input_mean)].to(units.input_mean))

    def marginals(self, sets: Tensor) -> tuple[Tensor, Tensor]:
        """Means (B, O, N) and covariances (B, O, N, N), double, without noise, at raw inputs (B, N, D)."""
        parts = [self._some(part) for part in torch.split(sets, max(_AT_ONCE // sets.shape[1], 1))]
        return torch.cat([m for m, _ in parts]), torch.cat([c for _, c in parts])

    def predict(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (N, O) at raw inputs (N, D), in raw units, of ordinary measurements.

        Those of Student noise have the deviation of its scale; outliers are wider.
        """
        prediction = self.prediction(inputs)
        return prediction.means[0], prediction.own_stds[0]

    def prediction(self, inputs: Tensor) -> Mixture:
        """All outputs of a measurement together at raw inputs (N, D), in raw units."""
        mean, covariance = self.marginals(inputs[:, None])
        std = (covariance[:, :, 0, 0].clamp_min(0.0) + self.noise_std**2).sqrt().float()
        turn = self.normaliser.error_turn
        if turn is None:
            std = std * self.normaliser.output_std
        return Mixture(
            self.normaliser.raw_outputs(mean[:, :, 0])[None], std[None], self.freedom, turn, self.correlation
        )

    def _some(self, sets: Tensor) -> tuple[Tensor, Tensor]:
        count, points = sets.shape[:2]
        flat = sets.flatten(0, 1)
        at = self.normaliser.inputs(flat).double()
        outputs = len(self.noise_std)
        if self.model is None or self.parameters is None:
            drawn = torch.zeros((outputs, 1, len(flat)), dtype=torch.float64, device=flat.device)
        else:
            drawn = _simulated(self.model, flat, self.parameters, self.normaliser).permute(2, 0, 1)
            at = torch.cat([at, drawn.mean(dim=1).T], dim=1)
        covariance = torch.zeros((count, outputs, points, points), dtype=torch.float64, device=flat.device)
        if self.gap is not None:
            covariance = self.gap(at.view(count, points, at.shape[1])).transpose(0, 1)
            if len(self.inputs):
                half = torch.linalg.solve_triangular(self.factor, self.gap(self.inputs, at), upper=False)
                drawn = drawn + self.white.transpose(1, 2) @ half
                blocks = half.view(outputs, len(self.inputs), count, points).permute(2, 0, 1, 3)  # (B, O, n, N)
                covariance = covariance - blocks.transpose(2, 3) @ blocks
        mean = drawn.mean(dim=1)
        off = (drawn - mean[:, None]).view(outputs, drawn.shape[1], count, points).permute(2, 0, 1, 3)
        covariance = covariance + off.transpose(2, 3) @ off / drawn.shape[1]
        return mean.view(outputs, count, points).transpose(0, 1).float(), covariance


def infer(
    model: DomainModel | None,
    inputs: Tensor,
    outputs: Tensor,
    normaliser: Normaliser,
    noise_std: Tensor,
    *,
    gap_std: Tensor | None = None,
    with_gap: bool = True,
    noise_known: bool = False,
    starts: Sequence[float] = STARTS,
    seed: int = 0,
) -> FunctionPosterior:
    """What data and simulator say.

    Args:
        model: the simulator; zero where it is None.
        inputs: raw (n, D); may be empty.
        outputs: raw (n, O).
        normaliser: of inputs and outputs.
        noise_std: expected noise, raw (O,).
        gap_std: expected error of the simulator, raw (O,); ``EXPECTED_GAP`` of the outputs' units unless given.
        with_gap: whether the simulator is allowed to be wrong.
        noise_known: whether the noise is what is expected where there is no gap; with one it is learned. How heavy its
            tails are, and its scale by rows left out, is told from ``ROWS_FOR_TAILS`` rows on all the same.
        starts: multiples of the gap's expected size from which its covariance is looked for; others than the first
            from ``ROWS_FOR_TAILS`` rows on.
        seed: of draws.

    Raises:
        DataError: numbers are missing or infinite, or a unit is zero; or the simulator gives no finite numbers.
    """
    if not (torch.isfinite(inputs).all() and torch.isfinite(outputs).all()):
        raise DataError("The data holds numbers that are missing or infinite; leave those rows out and fit again.")
    if len(inputs) != len(outputs):
        raise DataError(f"There are {len(inputs)} rows of inputs and {len(outputs)} of outputs; each row needs both.")
    if not all(bool((size > 0.0).all()) for size in (normaliser.input_std, normaliser.output_std, noise_std)):
        raise DataError("A unit or an expected noise is zero; each input and output needs one that is larger.")
    if len(inputs) > LARGEST:
        generator = torch.Generator().manual_seed(seed)
        some = torch.randperm(len(inputs), generator=generator)[:LARGEST].to(inputs.device)
        inputs, outputs = inputs[some], outputs[some]
    expected = EXPECTED_GAP * torch.ones_like(noise_std) if gap_std is None else gap_std / normaliser.output_std
    case = _Case(
        model, inputs, outputs, normaliser, (noise_std / normaliser.output_std).double(), expected.double(), with_gap,
        noise_known, seed,
    )  # fmt: skip
    return case.of_starts(starts) if with_gap and len(inputs) >= ROWS_FOR_TAILS else case.explained()[0]


@dataclass(frozen=True, slots=True)
class _Case:
    """What is to be explained, in normalised units."""

    model: DomainModel | None
    inputs: Tensor
    outputs: Tensor
    normaliser: Normaliser
    noise: Tensor
    expected: Tensor
    with_gap: bool
    noise_known: bool
    seed: int

    def of_starts(self, starts: Sequence[float]) -> FunctionPosterior:
        """The posterior of the first start, or of another by which rows that are left out are likelier for sure.

        Others are tried with the simulator's parameters that the first has found: they depend little on the start, and
        cost most.
        """
        first, *others = (replace(self, expected=start * self.expected) for start in starts)
        best, own = first.explained()
        parameters, most = best.parameters, 0.0
        for other in others:
            try:
                found, density = other.explained(parameters)
            except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
                continue  # A gap from which nothing can be computed; the first is there.
            ahead = density - own
            gain = float(ahead.mean())
            if gain > max(most, SURE * float(ahead.std()) / math.sqrt(len(ahead))):
                best, most = found, gain
        return best

    def explained(self, known_parameters: Tensor | None = None) -> tuple[FunctionPosterior, Tensor]:
        """The posterior, and the log density of each row (n,) when it is left out, from ``ROWS_FOR_TAILS`` on.

        Args:
            known_parameters: draws of the simulator's parameters given the data; they are found unless given.
        """
        model, normaliser, inputs = self.model, self.normaliser, self.inputs
        generator = torch.Generator().manual_seed(self.seed)
        x, y = normaliser.inputs(inputs).double(), normaliser.outputs(self.outputs).double()
        count, width = x.shape
        device = inputs.device
        noise, expected_noise, scale = self.noise, self.noise, torch.ones_like(self.noise)
        correlation = torch.eye(len(scale), dtype=torch.float64, device=device)
        share = SHARE_OF_MANY if count >= ROWS_FOR_TAILS else 1.0
        learned = count and (self.with_gap or not self.noise_known)
        most = freedom = max(count / ROWS_OF_A_FREEDOM, LEAST_FREEDOM) if learned else math.inf
        gap = GapCovariance.before_data(width, self.expected, share) if self.with_gap else None
        rows = torch.randperm(count, generator=generator)[:PARAMETER_ROWS].to(device)
        trust = torch.ones(count, dtype=torch.float64, device=device)
        parameters, density = known_parameters, torch.zeros_like(trust)
        if model is not None and parameters is None:
            parameters = draw_parameters(model, PRIOR_DRAWS if count else DRAWS, generator).to(inputs)
            if not count:
                domain = model.inputs(DOMAIN_ROWS, torch.Generator().manual_seed(self.seed)).to(inputs)
                parameters = parameters[_sound(_simulated(model, domain, parameters, normaliser))]
        left, known, seen = self._left(x, y, parameters, normaliser)
        if count >= ROWS_FOR_TAILS:
            before, doubt = gap, known

            def before_data(trust: Tensor) -> Tensor:
                own = _covariance(before, seen, self.noise, trust)
                return own if doubt is None else own + doubt

            trust = first_trust(left, before_data, self.noise)
        # The covariance is learned around the prior, then again around what the data leaves of it, in outputs that are
        # turned so that their errors are independent: a process of its own for each knows nothing of another's.
        for again in reversed(range(ROUNDS if count else 0)):
            if self.with_gap:
                said = None if model is None else seen[:, width:]
                gap, noise = learn_gap(x, left, known, expected_noise, self.expected, trust, said, self.seed, share)
            elif not self.noise_known:
                noise = learn_noise(left, known, expected_noise, trust, self.seed)
            if model is not None and known_parameters is None:
                some = rows[:FIRST_PARAMETER_ROWS] if again else rows
                factor = torch.linalg.cholesky(_covariance(gap, seen[some], noise, trust[some]))
                parameters = posterior_parameters(
                    model, inputs[some], self.outputs[some], factor, normaliser, DRAWS, generator
                )  # fmt: skip
                left, known, seen = self._left(x, y, parameters, normaliser)
            if count >= ROWS_FOR_TAILS:
                covariance = _covariance(gap, seen, noise, trust)
                white, doubt = left_out(left, covariance if known is None else covariance + known, noise, trust)
                correlation, wide = output_correlation(white)
                found, trust = student_weights(joint_surprise(white, correlation), len(noise))
                freedom = min(found, most)
                scale = typical_scale(white**2, freedom)
                density = left_out_density(white, doubt) + normaliser.log_volume
                if again:
                    # An output that never changes tells of no noise at all.
                    expected_noise = torch.maximum(wide * noise, LEAST_OF_EXPECTED * self.noise)
                    normaliser = normaliser.turned(turn_of(correlation, wide * doubt.median(dim=0).values.sqrt()))
                    y = normaliser.outputs(self.outputs).double()
                    left, known, seen = self._left(x, y, parameters, normaliser)
        factor = torch.linalg.cholesky(_covariance(gap, seen, noise, trust))
        every = y[None]
        if model is not None and parameters is not None:
            there = _simulated(model, inputs, parameters, normaliser)
            sound = _sound(there)
            parameters, every = parameters[sound], y - there[sound]
        white = torch.linalg.solve_triangular(factor, every.permute(2, 1, 0), upper=False)
        noise_std = torch.maximum(scale * noise, LEAST_OF_EXPECTED * self.noise).float()
        posterior = FunctionPosterior(
            normaliser, noise_std, freedom, correlation.float(), model, parameters, gap, seen, factor, white
        )
        return posterior, density

    def _left(
        self, x: Tensor, y: Tensor, parameters: Tensor | None, normaliser: Normaliser
    ) -> tuple[Tensor, Tensor | None, Tensor]:
        """What the mean of the draws leaves (n, O), the draws' covariance (O, n, n), and inputs for the gap."""
        if self.model is None or parameters is None:
            return y, None, x
        there = _simulated(self.model, self.inputs, parameters, normaliser)
        there = there[_sound(there)]
        mean = there.mean(dim=0)
        off = (there - mean).permute(2, 0, 1)
        return y - mean, off.transpose(1, 2) @ off / len(there), torch.cat([x, mean], dim=1)


def _simulated(model: DomainModel, inputs: Tensor, parameters: Tensor, normaliser: Normaliser) -> Tensor:
    """Normalised outputs (P, N, O)."""
    if not len(inputs):
        return torch.zeros((len(parameters), 0, len(normaliser.output_std)), dtype=torch.float64, device=inputs.device)
    with torch.no_grad():
        return normaliser.outputs(model(inputs, parameters)).double()


def _sound(simulated: Tensor) -> Tensor:
    """Which draws (P,) a simulator gives possible outputs (P, N, O) for: it may break down for some.

    Raises:
        DataError: for none.
    """
    found = (simulated.abs() < ABSURD).flatten(1).all(dim=1)
    if not bool(found.any()):
        raise DataError(BROKEN_DOWN)
    return found


def _covariance(gap: GapCovariance | None, inputs: Tensor, noise: Tensor, trust: Tensor) -> Tensor:
    """Covariances (O, n, n) of gap and noise; the noise of a row is the larger the less it is trusted."""
    of_noise = torch.diag_embed((noise**2)[:, None] / trust + TINY)
    return of_noise if gap is None else gap(inputs) + of_noise


__all__ = ["JITTER", "FunctionPosterior", "infer"]
