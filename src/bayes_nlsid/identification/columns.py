"""Everything that enters a residual as columns, in groups with names, and their triangular factor.

The groups: what no parameter changes; 2ζω and ω² of free modes; linear coefficients; values of laws at the places of their tables; stuck
springs. Recordings and equations share most of what is needed, so that it is worked out once.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.forces.term import Term
from bayes_nlsid.identification.observed import SPRING, Cell, Part
from bayes_nlsid.identification.problem import Piece, Problem

ROWS = 4096    # rows that join the triangle at a time, at least
Array = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class Columns:
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
        for label, vector in {**_own_vectors(problem, cell), base_label(problem): problem.base[cell.entries]}.items():
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
                triangle = triangle_of(np.concatenate([triangle, block[i:i + rows]]))
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
        return triangle_of(np.sqrt(values[kept])[:, None] * eigen[:, kept].T * norms)

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
                common = triangle_of(np.concatenate([common, np.hstack([v[i:i + rows] for v in shared.values()])]))
            for cell, atoms in cells:
                block = np.zeros((len(common), self.width))
                for label, parts in atoms.items():
                    first, width = self.labels[label]
                    for name, factor, _ in parts:
                        block[:, first:first + width] += factor * common[:, place[name]]
                triangle = triangle_of(np.concatenate([triangle, root[cell.entries.start] * block]))
        return triangle


def triangle_of(matrix: Array) -> Array:
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=float)


def base_label(problem: Problem) -> Hashable:
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


def linear_labels(problem: Problem) -> list[Hashable]:
    parameters = problem.model.parameters
    modes: list[Hashable] = [(name, k) for k in problem.model.free_modes for name in ("velocity", "displacement")]
    return modes + [("linear", parameters[i].name) for i in problem.linear_index]


def labels_of(problem: Problem) -> tuple[Hashable, ...]:
    """All groups of columns of a problem, each once."""
    laws = (label for piece in problem.pieces for label in law_labels(problem, piece))
    return tuple(dict.fromkeys((*linear_labels(problem), base_label(problem), *laws)))


def law_labels(problem: Problem, piece: Piece) -> list[Hashable]:
    term = piece.element.term
    labels: list[Hashable] = list(problem.observed.parts(term, piece.locations, problem.places, True, problem.kink(piece)))
    return [*labels, ("stuck", piece.locations)] if piece.element.excess and term.stiffness is not None else labels
