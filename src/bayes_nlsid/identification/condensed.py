"""The weighted residual in as few entries as it has columns: after that, no cost depends on the length of the recordings.

Where force tables hold all laws, the residual of Eq. 13 is a fixed matrix times a few hundred numbers (1; 2ζω and ω² of free modes; linear
coefficients; values of the laws at the places of their tables). Its triangular factor R has the same sum of squares at every point, and the
sum of squares of any sub-problem. R is built up block by block; unlike the product of the matrix with its transpose it keeps all digits.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.term import Term
from bayes_nlsid.identification.observed import SPRING, Cell, Observed, Part
from bayes_nlsid.identification.problem import Piece, Problem

ROWS = 4096    # rows that join the triangle at a time, at least
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

    def jacobian(self, s: Array, low: Array, high: Array) -> Array:
        """Derivative (B, n, K) of ``forces`` by the nonlinear search coordinates of s (B, P); steps inside the box, one piece at a time."""
        width = high - low
        free = [i for piece in self.problem.pieces for i in piece.columns]
        out = np.zeros((len(s), len(free), self.size))
        at = 0
        for i, piece in enumerate(self.problem.pieces):
            columns = list(piece.columns)
            count = len(columns)
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
        return self.base + self.linear_coefficients(theta) @ self.columns.T + self.forces(theta)


@final
@dataclass(frozen=True, eq=False)
class Condensed:
    """Factor of all columns that some problems need, whose recordings and weights (N,) are the same.

    ``labels``: first column and width of each group of columns; ``triangle`` (rows, K).
    """

    observed: Observed
    weights: Array = field(repr=False)
    labels: dict[Hashable, tuple[int, int]]
    triangle: Array = field(repr=False)

    def of(self, problem: Problem) -> Regression | None:
        """The regression of a problem whose columns are all here; None if some are not."""
        wanted = [*_linear_labels(problem), _base_label(problem)]
        laws = [_law_labels(problem, piece) for piece in problem.pieces]
        unknown = any(label not in self.labels for labels in (wanted, *laws) for label in labels)
        if unknown or problem.observed is not self.observed or _constant(problem):
            return None
        spans = [self.labels[label] for labels in (wanted, *laws) for label in labels]
        pick = np.concatenate([np.arange(first, first + width) for first, width in spans])
        own = _triangle(self.triangle[:, pick]) if len(pick) < self.triangle.shape[1] else self.triangle[:, pick]
        linear, matrices = len(wanted) - 1, []
        at = linear + 1
        for labels in laws:
            width = sum(self.labels[label][1] for label in labels)
            used = np.flatnonzero(own[:, at:at + width].any(axis=1))
            matrices.append(np.ascontiguousarray(own[:used[-1] + 1 if len(used) else 0, at:at + width]))
            at += width
        return Regression(problem, own[:, :linear].copy(), own[:, linear].copy(), tuple(matrices), None)


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
    for label in (*_linear_labels(problem), _base_label(problem), *(x for piece in problem.pieces for x in _law_labels(problem, piece))):
        width = label.places if isinstance(label, Part) else 1
        if label not in labels:
            labels[label] = (at, width)
            at += width
    if not tabled(problem, rough=True) or problem.size < WORTH * at or _constant(problem):
        return None
    root, source = np.sqrt(weights), _Columns(problem, labels, at)
    if all(np.ptp(weights[cell.entries]) <= 1e-12 * np.max(weights[cell.entries]) for cell in problem.cells):
        triangle = source.factored_by_record(root)
    elif problem.size * at**2 > LARGE:
        triangle = source.product(root)
    else:
        triangle = source.factored(root)
    return Condensed(problem.observed, weights, labels, triangle)


@final
@dataclass(frozen=True, eq=False)
class _Columns:
    """Everything that enters a residual, cell by cell, in the order of ``labels``; ``width`` columns in all."""

    problem: Problem
    labels: dict[Hashable, tuple[int, int]]
    width: int

    def atoms(self, cell: Cell) -> dict[Hashable, list[tuple[Hashable, float, Array]]]:
        """For each label, what it is made of in one cell: name, factor and in-band vectors (2 bins, w), which cells may share."""
        problem, seen = self.problem, self.problem.observed
        row = {name: seen.leverage(name)[seen.scenario.equations.index(cell.equation)] for name in self.locations}
        out: dict[Hashable, list[tuple[Hashable, float, Array]]] = {}
        for label, group in self.groups.items():
            term, excess = group[0], group[2]
            out[label] = [((label, name), row[name], seen.transformed(term, name, excess, cell.record)[:, None]) for name in group[1]]
        for label in self.labels:
            if isinstance(label, Part):
                out[label] = [((label, name), row[name], tables[cell.record].matrix)
                              for name, tables in zip(label.locations, seen.tables(label), strict=True)]
        for label, vector in {**_own_vectors(problem, cell), _base_label(problem): problem.base[cell.entries]}.items():
            out[label] = [((label, cell.equation), 1.0, vector[:, None])]
        return out

    @property
    def groups(self) -> dict[Hashable, tuple[Term, tuple[str, ...], bool]]:
        """Term, locations and excess of every linear coefficient and every stuck spring."""
        problem = self.problem
        out: dict[Hashable, tuple[Term, tuple[str, ...], bool]] = {}
        parameters = problem.model.parameters
        for i in problem.linear_index:
            entry = parameters[i]
            if entry.element >= 0:
                element = problem.model.elements[entry.element]
                out["linear", entry.name] = element.term, element.groups[entry.group], element.excess
        return out | {x: (SPRING, x[1], False) for x in self.labels if isinstance(x, tuple) and x[0] == "stuck"}

    @property
    def locations(self) -> tuple[str, ...]:
        """All that carry something."""
        return tuple(dict.fromkeys(name for element in self.problem.model.elements for name in element.locations))

    def block(self, cell: Cell) -> Array:
        """Unweighted columns (2 bins, width) of one cell."""
        out = np.zeros((2 * cell.bins, self.width))
        for label, parts in self.atoms(cell).items():
            first, width = self.labels[label]
            for _, factor, vectors in parts:
                out[:, first:first + width] += factor * vectors
        return out

    def factored(self, root: Array) -> Array:
        """Triangle by orthogonal factors of one block of rows after the other."""
        triangle, rows = np.zeros((0, self.width)), max(ROWS, 2 * self.width)
        for cell in self.problem.cells:
            block = root[cell.entries, None] * self.block(cell)
            for i in range(0, len(block), rows):
                triangle = _triangle(np.concatenate([triangle, block[i:i + rows]]))
        return triangle

    def product(self, root: Array) -> Array:
        """Triangle from the eigenvectors of the product of the columns with themselves.

        What equations share, the motion at the joints, is multiplied once, under the sum of their weights.
        """
        total = np.zeros((self.width, self.width))
        for record in range(len(self.problem.data)):
            cells = [cell for cell in self.problem.cells if cell.record == record]
            weights = np.stack([root[cell.entries] ** 2 for cell in cells])
            vectors: dict[Hashable, Array] = {}
            factors: dict[Hashable, Array] = {}
            place: dict[Hashable, slice] = {}
            for c, cell in enumerate(cells):
                for label, parts in self.atoms(cell).items():
                    first, width = self.labels[label]
                    for name, factor, columns in parts:
                        vectors[name], place[name] = columns, slice(first, first + width)
                        factors.setdefault(name, np.zeros(len(cells)))[c] += factor
            names = list(vectors)
            for i, one in enumerate(names):
                for other in names[i:]:
                    shared = factors[one] * factors[other]
                    if shared.any():
                        narrow, wide = sorted((one, other), key=lambda name: vectors[name].shape[1])
                        block = ((shared @ weights)[:, None] * vectors[narrow]).T @ vectors[wide]
                        total[place[narrow], place[wide]] += block
                        if one != other:
                            total[place[wide], place[narrow]] += block.T
        norms = np.sqrt(np.diagonal(total))
        norms = np.where(norms > 0, norms, 1.0)
        values, eigen = np.linalg.eigh(total / np.outer(norms, norms))
        kept = values > 1e-15 * values[-1]
        return _triangle(np.sqrt(values[kept])[:, None] * eigen[:, kept].T * norms)

    def factored_by_record(self, root: Array) -> Array:
        """As ``factored`` where every cell has one weight: what cells share is factored once."""
        triangle = np.zeros((0, self.width))
        for record in range(len(self.problem.data)):
            cells = [(cell, self.atoms(cell)) for cell in self.problem.cells if cell.record == record]
            shared: dict[Hashable, Array] = {}
            for _, atoms in cells:
                shared |= {name: vectors for parts in atoms.values() for name, _, vectors in parts}
            place, at = {}, 0
            for name, vectors in shared.items():
                place[name] = slice(at, at + vectors.shape[1])
                at += vectors.shape[1]
            common, rows = np.zeros((0, at)), max(ROWS, 2 * at)
            for i in range(0, 2 * cells[0][0].bins, rows):
                common = _triangle(np.concatenate([common, np.hstack([v[i:i + rows] for v in shared.values()])]))
            for cell, atoms in cells:
                block = np.zeros((len(common), self.width))
                for label, parts in atoms.items():
                    first, width = self.labels[label]
                    for name, factor, _ in parts:
                        block[:, first:first + width] += factor * common[:, place[name]]
                triangle = _triangle(np.concatenate([triangle, root[cell.entries.start] * block]))
        return triangle


def _triangle(matrix: Array) -> Array:
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=float)


def _base_label(problem: Problem) -> Hashable:
    """What no parameter changes depends on which parameters there are."""
    return "base", problem.model.free_modes, problem.model.free_gain


def _own_vectors(problem: Problem, cell: Cell) -> dict[Hashable, Array]:
    """Columns of one cell that no other cell has: free modes, gain of the force."""
    seen, here = problem.observed, cell.entries
    out: dict[Hashable, Array] = {}
    for k in problem.model.free_modes:
        own = 1.0 if k == cell.equation else 0.0
        out["velocity", k], out["displacement", k] = own * seen.velocity[here], own * seen.displacement[here]
    parameters = problem.model.parameters
    for i, column in zip(problem.linear_index, problem.columns, strict=True):
        if parameters[i].element < 0:
            out["linear", parameters[i].name] = column[here]
    return out


def _linear_labels(problem: Problem) -> list[Hashable]:
    parameters = problem.model.parameters
    modes: list[Hashable] = [(name, k) for k in problem.model.free_modes for name in ("velocity", "displacement")]
    return modes + [("linear", parameters[i].name) for i in problem.linear_index]


def _linear_vectors(problem: Problem) -> dict[Hashable, Array]:
    """Unweighted columns (N,) of everything linear, in the order of ``Regression.columns``."""
    seen, labels = problem.observed, _linear_labels(problem)
    modes = [np.where(seen.equation == k, column, 0.0) for k in problem.model.free_modes for column in (seen.velocity, seen.displacement)]
    return dict(zip(labels, [*modes, *problem.columns], strict=True))


def _law_labels(problem: Problem, piece: Piece) -> list[Hashable]:
    term = piece.element.term
    labels: list[Hashable] = list(problem.observed.parts(term, piece.locations, problem.places, True, problem.kink(piece)))
    return [*labels, ("stuck", piece.locations)] if piece.element.excess and term.stiffness is not None else labels


def _constant(problem: Problem) -> bool:
    """Whether some element has no free parameter at all, and so changes the base."""
    return any(not element.free for element in problem.model.elements)
