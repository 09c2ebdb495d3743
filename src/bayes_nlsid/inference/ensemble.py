"""Affine-invariant sampling by independent ensembles of emcee walkers; the only module that imports emcee.

Moves: differential evolution 0.7, with full-length jumps between modes 0.1, snooker 0.2. They need three to four times fewer
evaluations than the stretch move in 20 to 40 dimensions. The snooker move is our own: that of emcee 3.1.6 scales its step with the
distance to the anchor without paying for it, and gives a Gaussian in five dimensions 0.7 of its variance. Half of all proposals or more
come from a distribution learnt from the posterior itself (``proposal``). Walkers move in coordinates of their own (``ridges``);
everything that leaves a block is in search coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.executors import Crew
from bayes_nlsid.identification.fit import Fit
from bayes_nlsid.inference.block import Block, Walkers
from bayes_nlsid.inference.checkpoint import Checkpoints, identity
from bayes_nlsid.inference.convergence import LENGTH, Convergence, assess, integrated_time, stuck
from bayes_nlsid.inference.likelihood import Likelihood, WhittleLikelihood
from bayes_nlsid.inference.mixture import Mixture
from bayes_nlsid.inference.posterior import Posterior
from bayes_nlsid.inference.prior import Prior, default_priors
from bayes_nlsid.inference.proposal import Proposal, learn_proposal
from bayes_nlsid.inference.starting import centres, first_proposal, first_walkers, neighbourhoods, starting_fits
from bayes_nlsid.inference.target import Target
from bayes_nlsid.inference.unvisited import with_known_optima

FRESH, GOOD, FAIR = 0.5, 0.7, 0.2    # share of proposals from the mixture; from one of which so many are accepted
GAMMA = 1.7        # length of a snooker step (ter Braak and Vrugt 2008)
KEEP_FAILED = 20   # failed points remembered per block
ASKED = 4000       # draws on which two proposals are compared
Array = NDArray[np.float64]


def seeded(child: np.random.SeedSequence) -> tuple[Any, ...]:
    """State of the generator that emcee uses (Mersenne twister), from a spawned seed sequence."""
    return tuple(np.random.RandomState(np.random.MT19937(child)).get_state(legacy=True))


@cache
def _snooker_class() -> type:
    """The snooker move as a move of emcee, made when emcee is first needed."""
    from emcee.moves import RedBlueMove

    @final
    class Snooker(RedBlueMove):
        """Along the line to an anchor, by the difference of two other walkers projected on it (ter Braak and Vrugt 2008)."""

        def __init__(self) -> None:
            super().__init__(nsplits=4)

        def get_proposal(self, s: Array, c: Sequence[Array], random: np.random.RandomState) -> tuple[Array, Array]:
            """Proposals (n, P) for walkers ``s`` from three other groups, and the log of the Jacobian |q − z|^(P−1)/|s − z|^(P−1)."""
            picked = np.stack([group[random.randint(len(group), size=len(s))] for group in c])
            order = np.argsort(random.rand(3, len(s)), axis=0)
            anchor, first, second = (picked[order[i], np.arange(len(s))] for i in range(3))
            away = s - anchor
            before = np.linalg.norm(away, axis=1)
            unit = away / np.maximum(before, 1e-300)[:, None]
            proposal = s + GAMMA * unit * np.sum(unit * (first - second), axis=1)[:, None]
            after = np.linalg.norm(proposal - anchor, axis=1)
            moved = (before > 0) & (after > 0)
            ratio = np.where(moved, np.log(np.maximum(after, 1e-300)) - np.log(np.maximum(before, 1e-300)), -np.inf)
            return proposal, (s.shape[1] - 1.0) * ratio if s.shape[1] > 1 else np.where(moved, 0.0, -np.inf)

    return Snooker


@cache
def _fresh_class() -> type:
    """The independence move as a move of emcee, made when emcee is first needed."""
    from emcee.moves import RedBlueMove

    @final
    class Fresh(RedBlueMove):
        """A new place drawn from a mixture that stands still, whatever the old one (Tierney 1994)."""

        def __init__(self, mixture: Mixture | Proposal) -> None:
            super().__init__(nsplits=1)    # no walker asks another: all at once
            self.mixture = mixture

        def get_proposal(self, s: Array, c: Sequence[Array], random: np.random.RandomState) -> tuple[Array, Array]:
            """Proposals (n, P), and the log of the ratio of their densities g(s)/g(q)."""
            proposal = self.mixture.sample(len(s), np.random.default_rng(random.randint(2**31, size=4)))
            return proposal, self.mixture.log_density(s) - self.mixture.log_density(proposal)

    return Fresh


def moves(mixture: Mixture | Proposal | None = None) -> list[tuple[Any, float]]:
    """Moves and their shares."""
    from emcee.moves import DEMove

    local = [(DEMove(), 0.7), (DEMove(gamma0=1.0), 0.1), (_snooker_class()(), 0.2)]
    if mixture is None:
        return local
    fresh = GOOD if isinstance(mixture, Proposal) and mixture.accepted > FAIR else FRESH
    return [*((move, share * (1 - fresh)) for move, share in local), (_fresh_class()(mixture), fresh)]


def run_block(target: Target, start: Walkers, steps: int, mixture: Proposal | None = None) -> Block:
    """Advance one ensemble; the result depends on nothing but the arguments.

    Parameters
    ----------
    target : Target
    start : Walkers
        All of finite log density.
    steps : int
    mixture : Proposal or None
        From which half of the proposals are drawn, in coordinates of the walk.

    Returns
    -------
    Block
    """
    import emcee

    ridges = target.ridges
    count: list[int] = [0]
    where: list[Array] = []

    interrupted = [False]

    def density(z: Array) -> Array:
        # emcee prints what it catches; an interruption waits for the end of a block that is then thrown away.
        s = ridges.to_s(z)
        try:
            value, failed = target.parts(s) if not interrupted[0] else (np.full(len(s), -np.inf), np.zeros(len(s), dtype=bool))
        except KeyboardInterrupt:
            interrupted[0] = True
            return np.full(len(s), -np.inf)
        count[0] += int(failed.sum())
        if failed.any() and len(where) < KEEP_FAILED:
            where.extend(s[failed])
        return np.where(np.isfinite(value), value + ridges.log_jacobian(z), -np.inf)

    walkers, dimensions = start.s.shape
    sampler = emcee.EnsembleSampler(walkers, dimensions, density, moves=moves(mixture), vectorize=True)
    z = ridges.to_walk(start.s)
    state = emcee.State(z, log_prob=start.log_prob + ridges.log_jacobian(z), random_state=start.random)
    sampler.run_mcmc(state, steps, skip_initial_state_check=True, progress=False)
    if interrupted[0]:
        raise KeyboardInterrupt
    chain, value = np.array(sampler.get_chain()), np.array(sampler.get_log_prob())
    s, value = ridges.to_s(chain), value - ridges.log_jacobian(chain)
    final_state = Walkers(s[-1], value[-1], tuple(sampler.random_state))
    failed_at = target.to_theta(np.array(where[:KEEP_FAILED])) if where else np.zeros((0, dimensions))
    return Block(s, value, np.asarray(sampler.backend.accepted, dtype=float), final_state, count[0], failed_at)


def _advance(target: Target, task: tuple[Walkers, int, Proposal | None]) -> Block:
    """The same as a task that can be given away."""
    return run_block(target, *task)


# -- the run -------------------------------------------------------------------------------------------------------------------------

MOST_STEPS, BLOCK = 20_000, 200
LEAST_BURN, BURN_TIMES = 400, 10     # burn-in: at least so many steps, and so many autocorrelation times
LESSON, LESSONS = 800, 3             # steps after which a mixture is learnt again where the chain is slow, and how often at most
KEEP = 200_000                       # draws kept in a Posterior

Progress = Callable[[float, str], None]


def sample(fit: Fit, *, likelihood: Likelihood | None = None, priors: Sequence[Prior] | None = None, ensembles: int = 4,
           walkers: int | None = None, steps: int | None = None, most: int = MOST_STEPS, block: int = BLOCK, seed: int = 0,
           store: Path | str | None = None, progress: Progress | None = None, stop: Callable[[], bool] | None = None,
           executor: str | Executor = "local", workers: int = 1) -> Posterior:
    """Draw from the posterior of a fitted problem.

    Burn-in ends after ten autocorrelation times (at least 400 steps, at most a quarter of ``most``). During it walkers that stand still
    or lie far below their ensemble are re-drawn from the others and counted; after it nothing is touched. Then every ensemble goes on until
    all parameters have nested R-hat ≤ 1.01, a chain of 50 autocorrelation times and 400 effective samples, or ``most`` steps are done.
    A chain still slow after 800 steps is burn-in after all, up to three times: the mixture of its proposals is learnt again from it.

    Parameters
    ----------
    fit : Fit
        Multi-start fit; all its plausible optima seed walkers.
    likelihood : Likelihood or None
        None takes ``WhittleLikelihood(fit)``.
    priors : sequence of Prior or None
        None takes ``default_priors``.
    ensembles : int
        Independent ensembles; at least two are needed to see several modes.
    walkers : int or None
        Per ensemble, even, at least 2 P and 20; None takes 4 P.
    steps : int or None
        Steps after burn-in, instead of the rule.
    most : int
        Limit of steps, burn-in included.
    block : int
        Steps between checkpoints, decisions and calls of ``progress``.
    seed : int
        Each ensemble has its own child of SeedSequence(seed).
    store : Path or None
        Folder for checkpoints. A run that was killed goes on from the last finished block and ends in the same draws.
    progress : callable or None
        Called with the share done and a sentence.
    stop : callable or None
        Asked after every block; True ends the run with what there is, as does Ctrl-C.
    executor, workers
        Over whom ensembles are spread, as in ``executors.Crew``. The draws do not depend on it.

    Returns
    -------
    Posterior
        ``status`` says whether it may be used; read it.

    Raises
    ------
    ValueError
        If there is nothing to sample, a number is out of range, or priors do not fit the parameters.
    InputError
        If the posterior density is nowhere finite, or ``store`` holds another run.
    """
    chosen = WhittleLikelihood(fit) if likelihood is None else likelihood
    target = Target(chosen, tuple(default_priors(chosen.problem) if priors is None else priors))
    size = len(target.priors)
    count = max(20, 4 * size) if walkers is None else walkers
    if size == 0:
        raise ValueError("the problem has no free parameters; free a mode or add an element")
    if count < max(2 * size, 8) or count % 2 or ensembles < 1 or block < 10 or workers < 1 or most < block:
        raise ValueError(f"walkers {count} must be even and at least {max(2 * size, 8)}, ensembles {ensembles} and workers {workers} at "
                         f"least 1, "
                         f"block {block} at least 10, most {most} at least one block")
    first, second, third, fourth = np.random.SeedSequence(seed).spawn(4)
    middle = centres(target, starting_fits(fit, chosen))
    around = neighbourhoods(target, middle)
    starts = first_walkers(target, around, count, first.spawn(ensembles))
    generators = [seeded(child) for child in second.spawn(ensembles)]
    states = [Walkers(s, value, generator) for (s, value), generator in zip(starts, generators, strict=True)]
    kept = Checkpoints(Path(store), identity(target, starts, (seed, ensembles, count, block))) if store is not None else None
    run = _Run(target, block, most, steps, third, kept, progress, stop, mixture=first_proposal(target, around, fourth))
    with Crew(target, executor=executor, workers=min(workers, ensembles)) as crew:
        found = run.go(states, crew).posterior(seed)
    return with_known_optima(found, target, middle, seed)


@final
@dataclass(eq=False)
class _Run:
    """One run of ``sample``: what is fixed, then what grows block by block. The only mutable object of this room."""

    target: Target
    block: int
    most: int
    steps: int | None
    prune_seed: np.random.SeedSequence
    kept: Checkpoints | None
    progress: Progress | None
    stop: Callable[[], bool] | None
    blocks: list[list[Block]] = field(default_factory=list)     # by block, then ensemble
    burn_blocks: int | None = None
    mixture: Proposal | None = None
    first_burn: int | None = None
    lessons: int = 0
    redrawn: int = 0
    stopped: str = ""
    next_check: int = 0

    def go(self, states: list[Walkers], crew: Crew) -> _Run:
        """Run blocks until the rule holds, the budget is spent or somebody stops it."""
        try:
            while (len(self.blocks) + 1) * self.block <= self.most:
                self.blocks.append(self._one_block(states, crew))
                states = [b.end for b in self.blocks[-1]]
                if self.burn_blocks is None:
                    states = self._burn_in(states)
                elif self._enough():
                    return self
                self._tell()
                if self.stop is not None and self.stop():
                    self.stopped = "stopped on request"
                    return self
        except KeyboardInterrupt:
            self.stopped = "stopped from the keyboard"
        return self

    def _one_block(self, states: list[Walkers], crew: Crew) -> list[Block]:
        number = len(self.blocks)
        done = {i: block for i in range(len(states)) if self.kept is not None and (block := self.kept.read(i, number)) is not None}
        todo = [i for i in range(len(states)) if i not in done]
        for k, block in crew.run(_advance, [(states[i], self.block, self.mixture) for i in todo]):
            done[todo[k]] = block
            if self.kept is not None:
                self.kept.write(todo[k], number, block)
        return [done[i] for i in range(len(states))]

    def _chain(self, first: int) -> tuple[Array, Array, Array]:
        """Draws (M, N, W, P), log densities (M, N, W) and acceptance (M, W) from a block on."""
        part = self.blocks[first:]
        columns = list(zip(*part, strict=True))
        s = np.array([np.concatenate([b.s for b in column]) for column in columns])
        value = np.array([np.concatenate([b.log_prob for b in column]) for column in columns])
        accepted = np.array([sum(b.accepted for b in column) for column in columns]) / (self.block * len(part))
        return s, value, accepted

    def _burn_in(self, states: list[Walkers]) -> list[Walkers]:
        """Re-draw lost walkers; decide whether burn-in is over."""
        done = len(self.blocks) * self.block
        longest = self.most // 4 if self.steps is None else min(max(LEAST_BURN, self.steps), self.most // 2)
        half = self._chain(len(self.blocks) // 2)[0]
        tau = max(integrated_time(half[..., i]) for i in range(half.shape[-1]))
        if (done >= LEAST_BURN and done >= BURN_TIMES * tau) or done + self.block > longest:
            self.burn_blocks = len(self.blocks)
        self.mixture = self._learnt(half[:, half.shape[1] // 2 if len(self.blocks) == 1 else 0:])
        if self.burn_blocks is None and done < BURN_TIMES * tau / 2:   # walkers that are still on their way down are not lost
            return states
        last = self.blocks[-1]
        lost = stuck(np.array([b.log_prob for b in last]), np.array([b.accepted for b in last]) / self.block, half.shape[-1])
        return [self._redraw(state, lost[i], i) for i, state in enumerate(states)]

    def _redraw(self, state: Walkers, lost: NDArray[np.bool_], ensemble: int) -> Walkers:
        if not lost.any() or 2 * lost.sum() > len(lost):    # where most stand still, the rest is no better
            return state
        entropy = np.random.SeedSequence([*self.prune_seed.generate_state(2), len(self.blocks), ensemble])
        taken = np.random.default_rng(entropy).choice(np.flatnonzero(~lost), int(lost.sum()))
        s, value = state.s.copy(), state.log_prob.copy()
        s[lost], value[lost] = s[taken], value[taken]
        self.redrawn += int(lost.sum())
        return Walkers(s, value, state.random)

    def _enough(self) -> bool:
        steps = (len(self.blocks) - (self.burn_blocks or 0)) * self.block
        if self.steps is not None:
            return steps >= self.steps
        if steps < self.next_check:      # diagnostics cost as much as many steps: look again after a quarter more
            return False
        self.next_check = int(1.25 * steps)
        found = self._assess(*self._chain(self.burn_blocks or 0))
        slow = LENGTH * float(np.max(found.tau, initial=1.0)) > 3 * steps
        if not found.converged and slow and self.lessons < LESSONS and steps >= LESSON:
            self._learn_again()
        return found.converged

    def _learn_again(self) -> None:
        """A mixture learnt too early leaves part of the posterior to slow moves: what was drawn teaches a new one, and is dropped."""
        if self.first_burn is None:
            self.first_burn = self.burn_blocks or 0
        self.mixture = None
        self.mixture = self._learnt(self._chain(self.first_burn)[0])
        self.burn_blocks, self.next_check, self.lessons = len(self.blocks), 0, self.lessons + 1

    def _learnt(self, draws: Array) -> Proposal | None:
        """From draws (M, N, W, P), of all ensembles alike; what there is where that describes other walkers better than half of them can
        teach."""
        z = self.target.ridges.to_walk(draws.transpose(1, 2, 0, 3))
        known, teaching, asked = (x.reshape(-1, z.shape[-1]) for x in (z, z[:, ::2], z[:, 1::2]))
        found, half = learn_proposal(known, self.prune_seed), None
        if self.mixture is not None:
            half = learn_proposal(teaching, self.prune_seed)
            asked = asked[::max(1, len(asked) // ASKED)]
            if found is None or half is None or half.log_density(asked).mean() < self.mixture.log_density(asked).mean():
                return self.mixture
        return found

    def _assess(self, s: Array, value: Array, accepted: Array) -> Convergence:
        problem = self.target.problem
        return assess(s, value, accepted, names=problem.names, nonlinear=[p.param is not None for p in problem.model.parameters],
                      prior_sd=self.target.prior_sd, prior_mean=self.target.prior_mean, box=self.target.box,
                      logarithmic=self.target.coordinates.logarithmic.tolist(), redrawn=self.redrawn, stopped=self.stopped)

    def _tell(self) -> None:
        if self.progress is None:
            return
        done, budget = len(self.blocks) * self.block, self.most
        if self.burn_blocks is not None and len(self.blocks) > self.burn_blocks:    # right after burn-in nothing counts yet
            s = self._chain(max(self.burn_blocks, len(self.blocks) // 2))[0]
            wanted = self.steps or LENGTH * max(integrated_time(s[..., i]) for i in range(s.shape[-1]))
            budget = int(min(self.most, max(done, self.burn_blocks * self.block + min(wanted, self.most))))
        state = "burn-in" if self.burn_blocks is None else "sampling"
        self.progress(min(1.0, done / budget), f"{state}: {done} steps of about {budget}")

    def posterior(self, seed: int) -> Posterior:
        """Draws after burn-in with their diagnostics, thinned to a size that can be kept."""
        problem, priors = self.target.problem, self.target.priors
        if self.burn_blocks is None:
            self.stopped = self.stopped or f"{self.most} steps were not enough for burn-in"
        first = len(self.blocks) if self.burn_blocks is None else self.burn_blocks
        if first < len(self.blocks):
            s, value, accepted = self._chain(first)
        else:
            m, w = (len(self.blocks[0]), len(self.blocks[0][0].accepted)) if self.blocks else (1, 1)
            s, value, accepted = np.zeros((m, 0, w, len(priors))), np.zeros((m, 0, w)), np.zeros((m, w))
        convergence = self._assess(s, value, accepted)
        thin = max(1, s[..., 0].size // KEEP)
        failed = [b.failed_at for row in self.blocks for b in row if len(b.failed_at)]
        if self.progress is not None and not self.stopped:
            self.progress(1.0, f"{convergence.status}: {s.shape[1]} steps of {s.shape[0]} ensembles after {first * self.block} of burn-in")
        return Posterior(problem.names, tuple(p.unit for p in problem.model.parameters), self.target.to_theta(s[:, thin - 1::thin]),
                         value[:, thin - 1::thin], convergence, priors, seed, self.target.likelihood.describe(), first * self.block,
                         sum(b.failures for row in self.blocks for b in row),
                         np.concatenate(failed)[:KEEP_FAILED] if failed else np.zeros((0, len(priors))))
