"""A user's own force law from one line of text, with its exact slope.

The text is parsed, every node is checked against a short list, and the law is evaluated by walking the checked tree: nothing of
it is ever run as Python. Slopes come from forward differentiation (dual numbers), so they are exact.

The language: numbers, ``pi``, ``q`` (m), ``v`` (m/s), the names of the parameters, ``+ - * / **``, brackets, comparisons inside
``where(condition, yes, no)``, and the functions ``abs sign sqrt exp log tanh sin cos minimum maximum``.

    user_term("stribeck", "f_c*tanh(v/v_s)*(1 + a*exp(-(v/v_s)**2))",
              {"f_c": ("N", "force"), "v_s": ("m/s", "velocity"), "a": ("", "range", 0, 1)})
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Term

LONGEST = 2000  # characters of a formula
UNARY: dict[str, Callable[..., Any]] = {"abs": np.abs, "sign": np.sign, "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "tanh": np.tanh,
                                        "sin": np.sin, "cos": np.cos}
ARGUMENTS = {**dict.fromkeys(UNARY, 1), "minimum": 2, "maximum": 2, "where": 3}
OPERATORS: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}
COMPARISONS: dict[type[ast.cmpop], tuple[str, Callable[..., Any]]] = {
    ast.Lt: ("<", np.less), ast.LtE: ("<=", np.less_equal), ast.Gt: (">", np.greater), ast.GtE: (">=", np.greater_equal)}
COMPARE = dict(COMPARISONS.values())
LANGUAGE = "use numbers, pi, q, v, the parameters, + - * / **, comparisons inside where(...), and " + ", ".join(sorted(ARGUMENTS))

# A node of the checked tree: (kind, ...). Duals are (value, df/dq, df/dv); a slope of None is exactly zero.
Node = tuple[Any, ...]
Dual = tuple[Any, Any, Any]


@final
@dataclass(frozen=True)
class Formula:
    """A checked formula; called like any law, ``formula(q, v, *p)``.

    Parameters
    ----------
    text : str
    names : tuple of str
        Parameters in the order in which they are given.
    where : str
        File and field, for the error.

    Raises
    ------
    InputError
        If the text is not in the language, or names something that is neither q, v nor a parameter.
    """

    text: str
    names: tuple[str, ...]
    where: str = field(default="formula", compare=False)
    tree: Node = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tree", _Reader(self.text, self.names, self.where).read())

    @property
    def used(self) -> frozenset[str]:
        """Names that occur: parameters, q, v."""
        return frozenset(_names(self.tree))

    def __call__(self, q: Any, v: Any, *p: Any) -> NDArray[np.float64]:
        """Force, N; arguments broadcast."""
        values = {"q": (q, None, None), "v": (v, None, None), **{n: (x, None, None) for n, x in zip(self.names, p, strict=True)}}
        with np.errstate(all="ignore"):
            return np.asarray(_dual(self.tree, values)[0], dtype=float)

    def slope(self, q: Any, v: Any, *p: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(df/dq, df/dv), N/m and N s/m; 0 where it does not exist."""
        values = {"q": (q, 1.0, None), "v": (v, None, 1.0), **{n: (x, None, None) for n, x in zip(self.names, p, strict=True)}}
        with np.errstate(all="ignore"):
            dual = _dual(self.tree, values)
        return _finite(dual[1]), _finite(dual[2])

    def at_rest(self, *p: Any) -> NDArray[np.float64]:
        """df/dq at q = v = 0, N/m."""
        return self.slope(0.0, 0.0, *p)[0]


def _finite(x: Any) -> NDArray[np.float64]:
    value = np.asarray(0.0 if x is None else x, dtype=float)
    return np.where(np.isfinite(value), value, 0.0)


@final
class _Reader:
    """Turns the text into a checked tree."""

    def __init__(self, text: str, names: Sequence[str], where: str) -> None:
        self.text, self.names, self.where = text, frozenset(names) | {"q", "v"}, where

    def read(self) -> Node:
        if not isinstance(self.text, str) or not self.text.strip():
            raise self.refuse("the formula is empty", LANGUAGE)
        if len(self.text) > LONGEST:
            raise self.refuse(f"the formula has {len(self.text)} characters", f"keep it below {LONGEST}")
        try:
            body = ast.parse(self.text.strip(), mode="eval").body
            return self.number(body)
        except (SyntaxError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise self.refuse(f"the formula {self.text!r} cannot be read ({getattr(error, 'msg', error)})", LANGUAGE) from None
        except (RecursionError, MemoryError):
            raise self.refuse("the formula is nested too deeply", "split it or remove brackets") from None

    def refuse(self, problem: str, mend: str) -> InputError:
        return InputError(self.where, problem, mend)

    def number(self, node: ast.AST) -> Node:
        """A node that gives a number."""
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
            if abs(node.value) < 1e300:
                return "constant", float(node.value)
        if isinstance(node, ast.Name):
            if node.id == "pi" and "pi" not in self.names:
                return "constant", math.pi
            if node.id not in self.names:
                raise self.refuse(f"{node.id!r} is neither q, v nor a parameter", f"add it to the parameters, or {LANGUAGE}")
            return "name", node.id
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
            inner = self.number(node.operand)
            return inner if isinstance(node.op, ast.UAdd) else ("-", ("constant", 0.0), inner)
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return OPERATORS[type(node.op)], self.number(node.left), self.number(node.right)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ARGUMENTS:
            return self.call(node, node.func.id)
        raise self.refuse(f"{ast.unparse(node)!r} is not allowed in a formula", LANGUAGE)

    def call(self, node: ast.Call, name: str) -> Node:
        if node.keywords or len(node.args) != ARGUMENTS[name]:
            raise self.refuse(f"{name} takes {ARGUMENTS[name]} argument(s), got {ast.unparse(node)!r}", "separate them with commas")
        if name == "where":
            return "where", self.condition(node.args[0]), self.number(node.args[1]), self.number(node.args[2])
        return "call", name, *(self.number(argument) for argument in node.args)

    def condition(self, node: ast.AST) -> Node:
        if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS:
            return COMPARISONS[type(node.ops[0])][0], self.number(node.left), self.number(node.comparators[0])
        raise self.refuse(f"{ast.unparse(node)!r} is not a comparison", "write where(a < b, yes, no) with one of < <= > >=")


def _names(node: Node) -> set[str]:
    if node[0] in ("constant", "name"):
        return {node[1]} if node[0] == "name" else set()
    return set().union(*(_names(part) for part in node[1:] if isinstance(part, tuple)))


def _plus(x: Any, y: Any) -> Any:
    """Sum of two slopes, of which None is exactly zero."""
    return y if x is None else x if y is None else x + y


def _times(x: Any, slope: Any) -> Any:
    return None if slope is None else x * slope


def _dual(node: Node, values: Mapping[str, Dual]) -> Dual:
    """Value and slopes of a node."""
    kind = node[0]
    if kind == "constant":
        return node[1], None, None
    if kind == "name":
        return values[node[1]]
    if kind == "where":
        return _where(node, values)
    if kind == "call":
        return _function(node[1], [_dual(part, values) for part in node[2:]])
    a, b = _dual(node[1], values), _dual(node[2], values)
    if kind == "+":
        return a[0] + b[0], _plus(a[1], b[1]), _plus(a[2], b[2])
    if kind == "-":
        return a[0] - b[0], _plus(a[1], _times(-1.0, b[1])), _plus(a[2], _times(-1.0, b[2]))
    if kind == "*":
        return a[0] * b[0], _plus(_times(b[0], a[1]), _times(a[0], b[1])), _plus(_times(b[0], a[2]), _times(a[0], b[2]))
    if kind == "/":
        inverse = np.divide(1.0, b[0])
        value = a[0] * inverse
        return value, _times(inverse, _plus(a[1], _times(-value, b[1]))), _times(inverse, _plus(a[2], _times(-value, b[2])))
    return _power(a, b)


def _power(a: Dual, b: Dual) -> Dual:
    value = np.power(np.asarray(a[0], dtype=float), b[0])
    along, across = None, None
    if a[1] is not None or a[2] is not None:
        rate = b[0] * np.power(np.asarray(a[0], dtype=float), np.subtract(b[0], 1.0))
        along, across = _times(rate, a[1]), _times(rate, a[2])
    if b[1] is not None or b[2] is not None:
        rate = np.where(value == 0.0, 0.0, value * np.log(a[0]))
        along, across = _plus(along, _times(rate, b[1])), _plus(across, _times(rate, b[2]))
    return value, along, across


def _where(node: Node, values: Mapping[str, Dual]) -> Dual:
    compare, left, right = node[1]
    condition = COMPARE[compare](_dual(left, values)[0], _dual(right, values)[0])
    yes, no = _dual(node[2], values), _dual(node[3], values)
    return np.where(condition, yes[0], no[0]), _choose(condition, yes[1], no[1]), _choose(condition, yes[2], no[2])


def _choose(condition: Any, yes: Any, no: Any) -> Any:
    if yes is None and no is None:
        return None
    return np.where(condition, 0.0 if yes is None else yes, 0.0 if no is None else no)


def _function(name: str, arguments: list[Dual]) -> Dual:
    a = arguments[0]
    if name in ("minimum", "maximum"):
        b = arguments[1]
        first = np.less_equal(a[0], b[0]) if name == "minimum" else np.greater_equal(a[0], b[0])
        return np.where(first, a[0], b[0]), _choose(first, a[1], b[1]), _choose(first, a[2], b[2])
    value = UNARY[name](a[0])
    if name == "sign" or (a[1] is None and a[2] is None):
        return value, None, None
    rate = {"abs": lambda: np.sign(a[0]), "sqrt": lambda: np.divide(0.5, value), "exp": lambda: value,
            "log": lambda: np.divide(1.0, a[0]), "tanh": lambda: 1.0 - value * value, "sin": lambda: np.cos(a[0]),
            "cos": lambda: -np.sin(a[0])}[name]()
    return value, _times(rate, a[1]), _times(rate, a[2])


SYMBOLS = frozenset({"N", "m", "s", "kg", "rad", "Hz", "V"})
"""What units of a formula's parameters are made of; prefixes would contradict the values, which are SI."""
UNITS_OF_RULES = {"stiffness": ("N/m", "N m/rad"), "force": ("N", "N m"), "displacement": ("m", "rad"), "velocity": ("m/s", "rad/s")}


def user_term(name: str, formula: str, params: Mapping[str, Sequence[Any]], memory: Literal["none", "masing"] = "none", *,
              meaning: str = "", where: str = "") -> Term:
    """A term from a formula.

    Parameters
    ----------
    name : str
        Of the term; not one of the library.
    formula : str
        In the language above; with ``memory="masing"`` it is the curve of first loading.
    params : mapping of str to sequence
        Name → ``(unit, rule)`` or ``(unit, rule, lower, upper)``; see ``Param`` for the rules.
    memory : {"none", "masing"}
    meaning : str
        For reports.
    where : str
        File and field, for errors.

    Returns
    -------
    Term
        Parity, linearity, dissipation and the spring at rest are found by evaluating the formula.

    Raises
    ------
    InputError
        If formula or parameters cannot be used, or the force is not finite at some small motion or at rest.
    """
    place = where or f"term {name!r}"
    entries = tuple(_param(key, entry, place) for key, entry in params.items())
    law = Formula(formula, tuple(p.name for p in entries), f"{place}, formula")
    idle = [p.name for p in entries if p.name not in law.used]
    if idle or not law.used & {"q", "v"}:
        raise InputError(place, f"parameters {idle} do not occur in the formula" if idle else "the force depends on neither q nor v",
                         "remove them or use them" if idle else "write it in terms of q (m) and v (m/s)")
    if memory not in ("none", "masing"):
        raise InputError(f"{place}, memory", f"{memory!r} is unknown", "use none or masing")
    facts = _examine(law, entries, place)
    if memory == "masing" and ("v" in law.used or facts["parity"] != "odd"):
        raise InputError(place, "Masing's rules need a curve of first loading that is odd in q and free of v",
                         "rewrite it, or use memory none")
    return Term(name, formula, entries, law, law.slope, memory=memory, stiffness=law.at_rest if facts["spring"] else None,
                linear=facts["linear"], parity=facts["parity"], dissipative=facts["dissipative"] or memory == "masing", meaning=meaning,
                source="user")


def _param(name: str, entry: Sequence[Any], place: str) -> Param:
    where = f"{place}, parameter {name!r}"
    if not name.isidentifier() or name in ARGUMENTS or name in ("q", "v", "pi"):
        raise InputError(where, "the name cannot be used in a formula", "use letters, digits and _, and none of q, v, pi or a function")
    if isinstance(entry, str) or len(entry) not in (2, 4):
        raise InputError(where, f"{entry!r} is not (unit, rule) or (unit, rule, lower, upper)", "give the unit and the rule for its bounds")
    unit, rule = str(entry[0]).strip(), entry[1]
    written = re.sub(r"\^\([^)]*\)", "", unit)  # an exponent may hold a parameter's name
    foreign = [word for word in re.findall(r"[^\W\d_]+", written) if word not in SYMBOLS]
    if foreign:
        raise InputError(where, f"unit {unit!r} holds {foreign[0]!r}, which is no SI unit without prefix",
                         f"write it with {', '.join(sorted(SYMBOLS))}, for instance N/m^3, or empty for a plain number")
    expected = UNITS_OF_RULES.get(str(rule), (unit,))
    if unit not in expected:
        raise InputError(where, f"unit {unit!r} does not go with the rule {rule!r}", f"write {' or '.join(expected)}")
    try:
        plain = Param(name, unit, rule)
        return replace(plain, lower=float(entry[2]), upper=float(entry[3])) if len(entry) == 4 else plain
    except (TypeError, ValueError) as error:
        raise InputError(where, str(error), "use a rule of the table of parameters, and lower < upper") from None


def _examine(law: Formula, params: tuple[Param, ...], place: str) -> dict[str, Any]:
    """What evaluating the formula tells: finite, odd or even, linear in its coefficient, dissipative, a spring at rest."""
    p = [math.sqrt(x.lower * x.upper) if x.rule == "range" and x.lower > 0 else 0.5 * (x.lower + x.upper) if x.rule == "range" else 1.0
         for x in params]
    size = np.concatenate([[0.0], np.logspace(-7, 0, 15)])
    q, v = (grid.ravel() for grid in np.meshgrid(np.concatenate([size, -size]), np.concatenate([size, -size])))
    f = np.broadcast_to(law(q, v, *p), q.shape)
    if not np.isfinite(f).all():
        bad = int(np.argmin(np.isfinite(f)))
        raise InputError(f"{place}, formula", f"the force is {f[bad]} at q = {q[bad]:g} m, v = {v[bad]:g} m/s",
                         "guard roots, logarithms and divisions with abs, maximum or where")
    mirrored, scale = np.broadcast_to(law(-q, -v, *p), q.shape), np.abs(f).max()
    parity = "odd" if np.allclose(mirrored, -f, atol=1e-12 * scale) else "even" if np.allclose(mirrored, f, atol=1e-12 * scale) else "none"
    linear = len(params) == 1 and params[0].rule == "coefficient" and bool(
        np.allclose(law(q, v, 2.0), 2.0 * f, atol=0) and np.allclose(law(q, v, -1.0), -f, atol=0))
    phase = 2 * np.pi * (np.arange(400) + 0.5) / 400
    power = np.broadcast_to(law(1e-3 * np.cos(phase), -0.3 * np.sin(phase), *p), phase.shape) * -np.sin(phase)
    loss = bool(power.sum() > 1e-9 * np.abs(power).sum())
    return {"parity": parity, "linear": linear, "dissipative": loss, "spring": bool(np.any(law.at_rest(*p) != 0.0))}
