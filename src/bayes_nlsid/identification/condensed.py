"""The weighted residual in as few entries as it has columns: after that, no cost depends on the length of the recordings.

Where force tables hold all laws, the residual of Eq. 13 is a fixed matrix times a few hundred numbers (1; 2ζω and ω² of free modes; linear
coefficients; values of the laws at the places of their tables). Its triangular factor R has the same sum of squares at every point, and the
sum of squares of any sub-problem. R is built up block by block; unlike the product of the matrix with its transpose it keeps all digits.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.identification.columns import Columns, base_label, labels_of, law_labels, linear_labels, triangle_of
from bayes_nlsid.identification.observed import Observed, Part
from bayes_nlsid.identification.problem import Piece, Problem

WORTH = 1.2    # entries per column from which condensing is worth it
LARGE = 2e10   # multiplications from which unequal weights are worth the product of the columns
STEP = 1e-6    # of the box: differences for derivatives
Array = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Regression:
    """Weighted residual of a problem: base + columns · linear coefficients + forces of everything nonlinear, in n entries.

    Parameters
    ----------
    problem : Problem
    columns : ndarray (n, L)
        2ζω and ω² of every free mode, then linear coefficients.
    base : ndarray (n,)
        What no parameter changes.
    matrices : tuple of ndarray (m, M)
        For each piece of the problem: the first m entries of its force from the values of its law (``law_values``), the others being zero;
        empty where pieces are evaluated exactly.
    root : ndarray (N,) or None
        Square roots of the weights where the entries are those of the problem; None where they are condensed.
    """

    problem: Problem
    columns: Array = field(repr=False)
    base: Array = field(repr=False)
    matrices: tuple[Array, ...] = field(repr=False)
    root: Array | None = field(repr=False)

    @property
    def size(self) -> int:
        """Number of entries n."""
        return len(self.base)

    def forces(self, theta: Array) -> Array:
        """(B, n) of theta (B, P)."""
        out = np.zeros((len(theta), self.size))
        for i, piece in enumerate(self.problem.pieces):
            part = self._force(i, piece.values(theta))
            out[:, :part.shape[1]] += part
        return out

    def _force(self, index: int, values: Array) -> Array:
        """Weighted force (B, n), without zeros at its end, of one piece for parameters of its term (B, n_p)."""
        piece, seen = self.problem.pieces[index], self.problem.observed
        if self.root is None:
            return law_values(self.problem, piece, values) @ self.matrices[index].T
        return self.root * seen.force(piece.element.term, piece.locations, values, piece.element.excess, self.problem.places,
                                      self.problem.kink(piece))

    def jacobian(self, s: Array, low: Array, high: Array, moving: NDArray[np.bool_] | None = None) -> Array:
        """Derivative (B, n, K) of ``forces`` by the nonlinear search coordinates of s (B, P), or by those ``moving`` (K,) of them; steps
        inside the box, one piece at a time."""
        width = high - low
        free = [i for piece in self.problem.pieces for i in piece.columns]
        wanted = set(free if moving is None else np.array(free)[moving].tolist())
        out = np.zeros((len(s), len(wanted), self.size))
        at = 0
        for i, piece in enumerate(self.problem.pieces):
            columns = [k for k in piece.columns if k in wanted]
            count = len(columns)
            if not count:
                continue
            move = np.where(s[:, columns] + STEP * width[columns] <= high[columns], STEP, -STEP) * width[columns]
            rows = np.repeat(s[:, None], count + 1, axis=1)
            rows[:, np.arange(1, count + 1), columns] += move
            values = piece.values(self.problem.to_theta(rows))
            if self.root is None:    # differences of the laws first: a fifth of the products
                law = law_values(self.problem, piece, values)
                matrix = self.matrices[i]
                out[:, at:at + count, :len(matrix)] = ((law[:, 1:] - law[:, :1]) / move[:, :, None]) @ matrix.T
            else:
                force = self._force(i, values.reshape(-1, values.shape[-1])).reshape(len(s), count + 1, self.size)
                out[:, at:at + count] = (force[:, 1:] - force[:, :1]) / move[:, :, None]
            at += count
        return out.transpose(0, 2, 1)

    def linear_coefficients(self, theta: Array) -> Array:
        """(B, L) of theta (B, P): what ``columns`` are multiplied by."""
        omega, zeta = self.problem.model.linear_values(theta)
        modes = [x[:, k] for k in self.problem.model.free_modes for x in (2 * zeta * omega, omega**2)]
        return np.stack([*modes, *(theta[:, i] for i in self.problem.linear_index)], axis=-1) if self.columns.shape[1] \
            else np.zeros((len(theta), 0))

    def slope(self, theta: Array) -> Array:
        """Derivative (n, P) of the residual by all search coordinates at theta (P,): exact for what is linear, else differences."""
        problem, modes = self.problem, self.problem.model.free_modes
        s = problem.to_s(theta)
        stretch = np.exp(problem.coordinates.log_jacobian(s))
        out = np.zeros((self.size, problem.model.size))
        for i in range(len(modes)):
            omega, zeta = 2 * np.pi * theta[i], theta[len(modes) + i]
            velocity, displacement = self.columns[:, 2 * i], self.columns[:, 2 * i + 1]
            out[:, i] = 2 * np.pi * (2 * zeta * velocity + 2 * omega * displacement) * stretch[i]
            out[:, len(modes) + i] = 2 * omega * velocity * stretch[len(modes) + i]
        index = list(problem.linear_index)
        out[:, index] = self.columns[:, 2 * len(modes):] * stretch[index]
        free = [i for piece in problem.pieces for i in piece.columns]
        if free:
            low, high = problem.to_s(problem.bounds.T)
            out[:, free] = self.jacobian(s[None], low, high)[0]
        return out

    def residual(self, theta: Array) -> Array:
        """Weighted residual (B, n) of theta (B, P)."""
        out = self.forces(theta)
        out += self.base
        if self.columns.shape[1]:
            out += self.linear_coefficients(theta) @ self.columns.T
        return out


@final
@dataclass(frozen=True, eq=False)
class Condensed:
    """Factor of all columns that some problems need, whose recordings and weights (N,) are the same.

    ``labels``: first column and width of each group of columns; ``triangle`` (rows, K). ``core``: groups that many problems have in common,
    their orthogonal basis (rows, k) and triangle (k, k).
    """

    observed: Observed
    weights: Array = field(repr=False)
    labels: dict[Hashable, tuple[int, int]]
    triangle: Array = field(repr=False)

    core: tuple[tuple[Hashable, ...], Array, Array] | None = field(default=None, repr=False)

    def around(self, problem: Problem) -> Condensed:
        """The same, made quick for a problem and for others that add a few columns to it."""
        labels = labels_of(problem)
        if any(label not in self.labels for label in labels):
            return self
        return replace(self, core=(labels, *np.linalg.qr(self._pick(labels))))

    def _pick(self, labels: Sequence[Hashable]) -> Array:
        spans = [self.labels[label] for label in labels]
        return self.triangle[:, np.concatenate([np.arange(first, first + width) for first, width in spans])]

    def of(self, problem: Problem) -> Regression | None:
        """The regression of a problem whose columns are all here; None if some are not."""
        wanted, labels = [*linear_labels(problem), base_label(problem)], labels_of(problem)
        unknown = any(label not in self.labels for label in labels)
        if unknown or problem.observed is not self.observed or _constant(problem):
            return None
        columns = self._columns(labels)
        matrices = []
        for piece in problem.pieces:
            matrix = np.hstack([columns[label] for label in law_labels(problem, piece)])
            used = np.flatnonzero(matrix.any(axis=1))
            matrices.append(np.ascontiguousarray(matrix[:used[-1] + 1 if len(used) else 0]))
        linear, base = [columns[label] for label in wanted[:-1]], columns[wanted[-1]]
        return Regression(problem, np.hstack(linear) if linear else base[:, :0], base[:, 0].copy(), tuple(matrices), None)

    def _columns(self, labels: tuple[Hashable, ...]) -> dict[Hashable, Array]:
        """Columns of some groups with as many rows as they all need."""
        if self.core is None or not set(self.core[0]) <= set(labels):
            order, picked = labels, self._pick(labels)
            own = triangle_of(picked) if picked.shape[1] < self.triangle.shape[1] else picked
        else:
            known, basis, own = self.core
            more = tuple(label for label in labels if label not in known)
            order = (*known, *more)
            if more:
                added = self._pick(more)
                inside = basis.T @ added
                rest = triangle_of(added - basis @ inside)
                own = np.block([[own, inside], [np.zeros((len(rest), own.shape[1])), rest]])
        edges = np.cumsum([self.labels[label][1] for label in order])
        return dict(zip(order, np.split(own, edges[:-1], axis=1), strict=True))


def law_values(problem: Problem, piece: Piece, values: Array) -> Array:
    """Values (..., M) of a piece's law that multiply its columns, for parameters of the term (..., n_p)."""
    term, seen = piece.element.term, problem.observed
    parts = seen.parts(term, piece.locations, problem.places, True, problem.kink(piece))
    out = [seen.tables(part)[0][0].values(term, values) for part in parts]
    if piece.element.excess and term.stiffness is not None:
        out.append(-np.asarray(term.stiffness(*np.moveaxis(values, -1, 0)), dtype=float)[..., None])
    return np.concatenate(out, axis=-1)


def regression(problem: Problem, weights: Array, shared: Condensed | None = None, rough: bool = False) -> Regression:
    """The residual of a problem under weights (N,): condensed where tables allow it and it is worth it, else entry by entry.

    Parameters
    ----------
    problem : Problem
    weights : ndarray (N,)
    shared : Condensed or None
        Made with the same weights; used where it holds all that the problem needs.
    rough : bool
        Condense laws that jump as well: a place to begin, not a fit.

    Raises
    ------
    ValueError
        If the weights are not (N,), finite and not negative.
    """
    if weights.shape != (problem.size,) or not (np.isfinite(weights).all() and (weights >= 0).all()):
        raise ValueError(f"weights must be ({problem.size},), finite and not negative, got shape {weights.shape}")
    found = None
    if rough or tabled(problem):
        found = shared.of(problem) if shared is not None and np.array_equal(shared.weights, weights) else None
        if found is None and (own := condense(problem, weights)) is not None:
            found = own.of(problem)
    if found is not None:
        return found
    root = np.sqrt(weights)
    vectors = _linear_vectors(problem)
    columns = np.stack(list(vectors.values()), axis=1) if vectors else np.zeros((problem.size, 0))
    return Regression(problem, root[:, None] * columns, root * problem.base, (), root)


def tabled(problem: Problem, rough: bool = False) -> bool:
    """Whether tables hold every law of a problem; with ``rough`` their jumps may be blurred."""
    return all(problem.observed.parts(p.element.term, p.locations, problem.places, rough) for p in problem.pieces)


def condense(problem: Problem, weights: Array) -> Condensed | None:
    """Factor of a problem's columns, jumps of laws blurred; None where a law has no table or the entries are hardly more than columns.

    Where all entries of an equation have one weight, the motion at the joints is factored once for all equations. Where weights differ and
    the recordings are long, the factor comes from the product of the columns with themselves: seven times faster, and the last digits that
    it costs lie far below the noise that made the weights differ.
    """
    labels: dict[Hashable, tuple[int, int]] = {}
    at = 0
    for label in labels_of(problem):
        labels[label] = (at, label.places if isinstance(label, Part) else 1)
        at += labels[label][1]
    if not tabled(problem, rough=True) or problem.size < WORTH * at or _constant(problem):
        return None
    root, source = np.sqrt(weights), Columns(problem, labels, at)
    if all(np.ptp(weights[cell.entries]) <= 1e-12 * np.max(weights[cell.entries]) for cell in problem.cells):
        triangle = source.factored_by_record(root)
    elif problem.size * at**2 > LARGE:
        triangle = source.product(root)
    else:
        triangle = source.factored(root)
    return Condensed(problem.observed, weights, labels, triangle)


def _linear_vectors(problem: Problem) -> dict[Hashable, Array]:
    """Unweighted columns (N,) of everything linear, in the order of ``Regression.columns``."""
    seen, labels = problem.observed, linear_labels(problem)
    modes = [np.where(seen.equation == k, column, 0.0) for k in problem.model.free_modes for column in (seen.velocity, seen.displacement)]
    return dict(zip(labels, [*modes, *problem.columns], strict=True))


def _constant(problem: Problem) -> bool:
    """Whether some element has no free parameter at all, and so changes the base."""
    return any(not element.free for element in problem.model.elements)
