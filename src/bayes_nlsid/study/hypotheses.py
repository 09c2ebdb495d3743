"""The user's own hypotheses, from a file: rows for the catalogue of what may be missing, their laws in the checked language.

    [[hypotheses]]
    name = "stribeck"
    claim = "friction at {place} falls once it slides"
    law = "f*tanh(v/w)*(1 + a*exp(-(v/w)**2))"
    params = { f = ["N", "force"], w = ["m/s", "velocity"], a = ["", "range", 0.0, 2.0] }
    follows = "velocity"
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.expression import user_term
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Term
from bayes_nlsid.mismatch.catalogue import ROWS, Row
from bayes_nlsid.mismatch.laws import Law, Size
from bayes_nlsid.study.reading_method import read_params
from bayes_nlsid.study.table import Table, nearest, parse_toml

Array = NDArray[np.float64]
MOST = 20      # hypotheses in a file
SHAPES = 64    # shapes of one law that are tried at every place
STARTS = {"displacement": (0.5, 1.0, 2.0, 4.0), "velocity": (0.05, 0.3, 1.0, 3.0)}
"""Where lengths and velocities begin, over the rms of the motion at the place."""


def read_hypotheses(path: Path | str) -> tuple[Row, ...]:
    """Rows for `mismatch.catalogue.with_rows` from a TOML file.

    Raises
    ------
    InputError
        On the first thing that cannot be used, naming file, entry and key.
    """
    file = Path(path)
    top = Table(file, "", parse_toml(file, "give the path of a file with [[hypotheses]]"))
    tables = list(top.tables("hypotheses"))
    top.close()
    if not 0 < len(tables) <= MOST:
        raise top.wrong("[[hypotheses]]", f"has {len(tables)} entries", f"write 1 to {MOST} tables headed [[hypotheses]]")
    rows: list[Row] = []
    for table in tables:
        rows.append(_row(table, [row.name for row in rows]))
    known = [*ROWS, *(row.name for row in rows)]
    for table, row in zip(tables, rows, strict=True):
        for name in row.confused:
            if name not in known:
                raise table.wrong("confused", f"{name!r} is no class of the catalogue", nearest(name, known))
    return tuple(rows)


def _row(table: Table, before: Sequence[str]) -> Row:
    name, claim = table.text("name"), table.text("claim")
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", name):
        raise table.wrong("name", f"{name!r} cannot be the name of a class", "use small letters, digits and _, for instance stribeck")
    if name in ROWS or name in before:
        raise table.wrong("name", f"{name!r} is in the catalogue already", "choose another name; nlsid hypotheses lists those taken")
    if "{place}" not in claim or re.search(r"[{}]", claim.replace("{place}", "")):
        raise table.wrong("claim", f"{claim!r} does not say where", "write {place} where the place is named, and no other braces")
    prior = table.number("prior", default=1.0, positive=True)
    if prior > 100:
        raise table.wrong("prior", f"{prior:g} would outweigh all evidence", "write a weight up to 100; a class of the catalogue has 1")
    law, follows = _law(table, name)
    row = Row(name, "force", claim, "joints", prior, follows, table.texts("confused", ()),
              table.text("test", "one more level of excitation, below the lowest or above the highest"), (law,))
    table.close()
    return row


def _law(table: Table, name: str) -> tuple[Law, str]:
    """The law with its starts, and what it follows."""
    params = read_params(table.table("params"))
    try:
        term = user_term(name, table.text("law"), dict(params), meaning=table.text("meaning", ""))
    except InputError as error:
        raise InputError(f"{table.file.name}: {table.name} {error.where}", error.problem, error.mend) from None
    follows = table.text("follows", "velocity" if term.dissipative else "displacement", ("displacement", "velocity"))
    factor = _factor(table, term)
    fixed = table.texts("fixed", ())
    names = [p.name for p in term.params]
    for word in fixed:
        if word not in names or word == names[factor]:
            others = ", ".join(n for n in names if n != names[factor])
            raise table.wrong("fixed", f"{word!r} cannot be held", f"name some of {others}" if others else "leave fixed out")
    starts = _starts(table, term.params, factor, fixed)
    free = tuple("fixed" if p.name in fixed else "signed" if p.rule == "coefficient" else
                 "linear" if p.rule == "range" and p.lower <= 0 else "log" for p in term.params)
    return Law(term, _Shapes(term.params, factor, starts), free, (factor,), signed=term.params[factor].rule == "coefficient"), follows


def _factor(table: Table, term: Term) -> int:
    """Which parameter the force is proportional to; the others shape it."""
    sized = [i for i, p in enumerate(term.params) if p.rule in ("force", "stiffness", "coefficient")]
    if len(sized) != 1:
        raise table.wrong("params", f"hold {len(sized)} forces, stiffnesses or coefficients",
                          "state the law with one of them as its factor and the rest as lengths, velocities or ratios (range)")
    rng = np.random.default_rng(0)
    q, v = 1e-3 * rng.standard_normal(200), 0.1 * rng.standard_normal(200)
    p = np.array([0.5 * (x.lower + x.upper) if x.rule == "range" else {"displacement": 1e-3, "velocity": 0.1}.get(x.rule, 1.0)
                  for x in term.params])
    twice = p.copy()
    twice[sized[0]] *= 2
    one, two = (np.asarray(term.static_force(q, v, x)) for x in (p, twice))
    if not (np.isfinite(one).all() and np.abs(one).max() > 0 and np.allclose(two, 2 * one, rtol=1e-9, atol=1e-12 * np.abs(one).max())):
        raise table.wrong("law", f"is not proportional to {term.params[sized[0]].name}",
                          "write it as that parameter times a shape")
    return sized[0]


def _starts(table: Table, params: Sequence[Param], factor: int, fixed: Sequence[str]) -> Mapping[int, tuple[float, ...]]:
    """For every parameter that shapes the force: where the search begins; lengths and velocities over the rms of the motion."""
    inner = table.table("start")
    names = [p.name for p in params]
    given = {} if inner is None else {key: inner.numbers(key) for key in inner.keys()}
    for key, values in given.items():
        assert inner is not None
        if key not in names or key == names[factor]:
            raise inner.wrong(key, "is no parameter that shapes the force", nearest(key, [n for n in names if n != names[factor]]))
        p = params[names.index(key)]
        low, high = (p.lower, p.upper) if p.rule == "range" else (0.0, np.inf)
        if not values or any(not (low <= x <= high and (x > 0 or p.rule == "range")) for x in values):
            mend = (f"write values between {low:g} and {high:g}" if p.rule == "range" else
                    "write multiples, above zero, of the rms of the motion at the place")
            raise inner.wrong(key, f"{list(values)} leaves its range", mend)
    out = {i: given.get(p.name, (1.0,) if p.name in fixed and p.rule != "range" else _usual(p))
           for i, p in enumerate(params) if i != factor}
    count = int(np.prod([len(x) for x in out.values()]))
    if count > SHAPES:
        raise table.wrong("start", f"makes {count} combinations", f"give fewer starts for some parameters, {SHAPES} combinations at most")
    return out


def _usual(p: Param) -> tuple[float, ...]:
    if p.rule != "range":
        return STARTS[p.rule]
    inside = np.geomspace(p.lower, p.upper, 5)[1:4:2] if p.lower > 0 else p.lower + (p.upper - p.lower) * np.array([0.25, 0.75])
    return tuple(float(x) for x in inside)


@final
class _Shapes:
    """The shapes from which the search starts, as a ``Law`` asks for them; a class, so that it can be sent to another process."""

    def __init__(self, params: Sequence[Param], factor: int, starts: Mapping[int, tuple[float, ...]]) -> None:
        self._rules, self._factor, self._starts = tuple(p.rule for p in params), factor, dict(starts)

    def __call__(self, size: Size) -> Array:
        """(K, n_p) for a motion of this size, the factor one."""
        unit = {"displacement": size.displacement, "velocity": size.velocity}
        axes = [(1.0,) if i == self._factor else tuple(x * unit.get(rule, 1.0) for x in self._starts[i])
                for i, rule in enumerate(self._rules)]
        return np.array(list(product(*axes)))
