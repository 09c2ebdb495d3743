"""The library: Table 1 as one list of terms, a few everyday ones beside it, and the terms with memory.

Adding a term by hand takes no more than this::

    import numpy as np
    from bayes_nlsid.forces.parameter import Param
    from bayes_nlsid.forces.term import Term

    stribeck = Term(
        name="stribeck", formula="f_c*tanh(v/v_s)*(1 + 0.3*exp(-(v/v_s)**2))",
        params=(Param("f_c", "N", "force"), Param("v_s", "m/s", "velocity")),
        law=lambda q, v, f_c, v_s: f_c * np.tanh(v / v_s) * (1 + 0.3 * np.exp(-((v / v_s) ** 2))),
        slope=lambda q, v, f_c, v_s: (0.0, f_c / v_s * (np.exp(-((v / v_s) ** 2)) * (0.3 / np.cosh(v / v_s) ** 2
            - 0.6 * v / v_s * np.tanh(v / v_s)) + 1 / np.cosh(v / v_s) ** 2)),
        dissipative=True)

or one line with ``user_term`` (``forces/expression.py``), which finds the slope itself.

How the printed table was read where the scan is doubtful (``confidence`` M or L): 24 and 25 complete the family |q|^n v; 35–41 are
taken as functions of the velocity, after the marks over 39 and 40; the argument of the exponential in 43 is taken as the velocity
(Prager's parallel arrangement). Section 3.1 of the paper calls the four-parameter Iwan element "No 39"; everywhere else it is 45.
"""

from __future__ import annotations

from functools import partial

from bayes_nlsid.errors import InputError
from bayes_nlsid.forces import laws
from bayes_nlsid.forces.parameter import Param
from bayes_nlsid.forces.term import Confidence, Law, Slope, Term

PAPER = "Safari and Londoño Monsalve 2023, Table 1"
SLIP = Param("f_s", "N", "force", meaning="force at which the whole contact slips")
STICK = Param("k_t", "N/m", "stiffness", meaning="tangential stiffness while the contact sticks")
CHI = Param("chi", "", "range", -0.9999, 1.0, "exponent of the slider density: micro-slip damping grows like amplitude^(chi+1)")
BETA = Param("beta", "", "range", 0.0, 10.0, "stiffness that slips last, at phi_max, over stiffness of the continuous density")
THETA = Param("theta", "", "range", 0.01, 1.0, "sliding over breaking force of a slider")


def _unit(displacement: float, velocity: float = 0.0) -> str:
    """Unit of a coefficient of |q|^displacement |v|^velocity: N divided by that."""
    metres, seconds = displacement + velocity, velocity

    def factor(symbol: str, power: float) -> str:
        return symbol if power == 1 else f"{symbol}^{power:g}"

    top = "N" + (f" {factor('s', seconds)}" if seconds else "")
    return top + (f"/{factor('m', metres)}" if metres else "")


def _power(symbol: str, power: float, odd: bool) -> str:
    """Formula of |x|^n or sgn(x)|x|^n in words of numpy, with the fewest signs."""
    whole = power == int(power)
    if power == 0:
        return f"sign({symbol})" if odd else "1"
    if whole and (int(power) % 2 == 1) == odd:
        return symbol if power == 1 else f"{symbol}**{power:g}"
    size = f"abs({symbol})" if power == 1 else f"abs({symbol})**{power:g}"
    return f"sign({symbol})*{size}" if odd else size


def _bound(family: str, power: float, odd: bool) -> tuple[Law, Slope]:
    """Law and slope of a monomial with its exponent bound."""
    name = f"{family}_{'odd' if odd else 'even'}"
    return partial(getattr(laws, name), power=float(power)), partial(getattr(laws, f"{name}_slope"), power=float(power))


def _coefficient(unit: str) -> tuple[Param, ...]:
    return (Param("c", unit, "coefficient", meaning="coefficient"),)


def _displacement(index: int | None, name: str, power: float, meaning: str, odd: bool = True, confidence: Confidence = "H") -> Term:
    law, slope = _bound("displacement", power, odd)
    return Term(name, f"c*{_power('q', power, odd)}", _coefficient(_unit(power)), law, slope, index=index, linear=True,
                parity="odd" if odd else "even", confidence=confidence if index else "-",
                meaning=meaning, source=PAPER if index else "")


def _mixed(index: int, name: str, power: float, odd: bool, meaning: str, confidence: Confidence = "H") -> Term:
    law, slope = _bound("mixed", power, odd)
    return Term(name, f"c*{_power('q', power, odd)}*v", _coefficient(_unit(power, 1)), law, slope, index=index, linear=True,
                parity="even" if odd else "odd", dissipative=not odd, confidence=confidence,
                meaning=meaning, source=PAPER)


def _velocity(index: int, name: str, power: float, odd: bool, meaning: str, confidence: Confidence = "H") -> Term:
    law, slope = _bound("velocity", power, odd)
    return Term(name, f"c*{_power('v', power, odd)}", _coefficient(_unit(0, power)), law, slope, index=index, linear=True,
                parity="odd" if odd else "even", dissipative=odd, confidence=confidence,
                meaning=meaning, source=PAPER)


_HARDENS = "spring that stiffens (c > 0) or softens (c < 0) with amplitude"
_ROOT = "spring that is steepest at rest and eases with amplitude"
_TURNS = "product of displacement and velocity that takes no energy over a symmetric cycle"
_GROWS = "damping that grows with displacement, as slip does"
_DRAG = "drag that grows faster than velocity"
_BIAS = "force that does not change sign with velocity: a bias, no damping"

_MONOMIALS = (
    _displacement(1, "q|q|", 2, _HARDENS),
    _displacement(2, "cubic", 3, "cubic spring, Duffing's: " + _HARDENS),
    _displacement(3, "|q|q^3", 4, _HARDENS),
    _displacement(4, "quintic", 5, _HARDENS),
    _displacement(5, "|q|q^5", 6, _HARDENS),
    _displacement(6, "q^7", 7, _HARDENS),
    _displacement(7, "sgn(q)|q|^0.5", 0.5, _ROOT),
    _displacement(8, "q|q|^0.5", 1.5, _HARDENS + ", as a sphere on a plane"),
    _displacement(9, "q|q|^1.5", 2.5, _HARDENS),
    _displacement(10, "q^3|q|^0.5", 3.5, _HARDENS, confidence="M"),
    _mixed(11, "qv", 1, True, _TURNS),
    _mixed(12, "q|q|v", 2, True, _TURNS),
    _mixed(13, "q^3v", 3, True, _TURNS),
    _mixed(14, "|q|q^3v", 4, True, _TURNS),
    _mixed(15, "q^5v", 5, True, _TURNS),
    _mixed(16, "|q|q^5v", 6, True, _TURNS),
    _mixed(17, "q^7v", 7, True, _TURNS),
    _mixed(18, "sgn(q)|q|^0.5v", 0.5, True, _TURNS),
    _mixed(19, "q|q|^0.5v", 1.5, True, _TURNS),
    _mixed(20, "q|q|^1.5v", 2.5, True, _TURNS),
    _mixed(21, "q^3|q|^0.5v", 3.5, True, _TURNS),
    _mixed(22, "|q|^0.5v", 0.5, False, _GROWS),
    _mixed(23, "|q|v", 1, False, _GROWS),
    _mixed(24, "|q|^1.5v", 1.5, False, _GROWS, "L"),
    _mixed(25, "q^2v", 2, False, _GROWS + ", as in van der Pol's oscillator", "L"),
    _velocity(26, "coulomb", 0, True, "dry friction: a force of constant size against the motion"),
    _velocity(27, "v|v|", 2, True, "quadratic damping: drag of air or water, loss at a throttle"),
    _velocity(28, "v^3", 3, True, _DRAG),
    _velocity(29, "|v|v^3", 4, True, _DRAG),
    _velocity(30, "v^5", 5, True, _DRAG),
    _velocity(31, "|v|v^5", 6, True, _DRAG),
    _velocity(32, "v^7", 7, True, _DRAG, "M"),
    _velocity(33, "|v|v^7", 8, True, _DRAG, "M"),
    _velocity(34, "v^9", 9, True, _DRAG, "L"),
    _velocity(35, "|v|^0.5", 0.5, False, _BIAS, "L"),
    _velocity(36, "v^2", 2, False, _BIAS, "L"),
    _velocity(37, "|v|^3", 3, False, _BIAS, "L"),
    _velocity(38, "v^4", 4, False, _BIAS, "L"),
    _velocity(39, "|v|^5", 5, False, _BIAS, "L"),
    _velocity(40, "v^6", 6, False, _BIAS, "L"),
    _velocity(41, "|v|^7", 7, False, _BIAS, "L"),
)

_REACH = "f_s*(1 + beta)/(k_t*(beta + (chi + 1)/(chi + 2)))"
_IWAN4 = (f"sign(q)*where(abs(q) < {_REACH}, k_t*abs(q)*(1 - (abs(q)/({_REACH}))**(chi + 1)/((1 + beta)*(chi + 2))), f_s)")
_IWAN5 = (f"sign(q)*where(abs(q) < {_REACH}, k_t*abs(q)*(1 + (chi + 1)/(1 + beta)*(theta/(chi + 2) - 1/(chi + 1))"
          f"*(abs(q)/({_REACH}))**(chi + 1)), theta*f_s)")
_JENKINS = "where(abs(k_t*q) < f_s, k_t*q, f_s*sign(q))"

_CONTACT = (
    Term("jenkins", _JENKINS, (SLIP, STICK), laws.jenkins, laws.jenkins_slope, stiffness=laws.jenkins_stiffness, index=42,
         confidence="H", meaning="spring that yields at f_s; as printed it follows the same line back and loses no energy", source=PAPER),
    Term("jenkins_prager", "f_s*(2/(1 + exp(-2*sigma*v)) - 1) + k_t*q",
         (SLIP, STICK, Param("sigma", "s/m", "range", 1e-2, 1e7, "one over the velocity at which friction is built up")),
         laws.jenkins_prager, laws.jenkins_prager_slope, stiffness=laws.jenkins_prager_stiffness, index=43, dissipative=True,
         confidence="L", meaning="rounded dry friction beside a spring; with the spring in the linear model only the friction acts",
         source=PAPER),
    Term("clearance", "where(abs(q) > d/2, k_d*sign(q)*(abs(q) - d/2), 0)",
         (Param("k_d", "N/m", "stiffness", meaning="stiffness once the gap is closed"),
          Param("d", "m", "displacement", meaning="full width of the gap")),
         laws.clearance, laws.clearance_slope, index=44, confidence="H", meaning="gap: no force until the play is used up", source=PAPER),
    Term("iwan4", _IWAN4, (SLIP, STICK, CHI, BETA), laws.iwan4, laws.iwan4_slope, stiffness=laws.iwan4_stiffness, index=45,
         confidence="H", meaning="four-parameter Iwan element as a spring that softens: its backbone, without the loop",
         source=PAPER + "; Segalman 2005"),
    Term("iwan5", _IWAN5, (SLIP, STICK, CHI, BETA, THETA), laws.iwan5, laws.iwan5_slope, stiffness=laws.iwan5_stiffness, index=46,
         confidence="H", meaning="five-parameter Iwan element as a spring that softens: its backbone, without the loop",
         source=PAPER + "; Mignolet, Song and Wang 2015"),
)

TABLE_1: tuple[Term, ...] = _MONOMIALS + _CONTACT

_BESIDE = (
    _displacement(None, "square", 2, "quadratic spring: stiffer one way than the other", odd=False),
    Term("spring", "k*q", (Param("k", "N/m", "coefficient", meaning="stiffness that the linear model lacks (or has too much of)"),),
         laws.spring, laws.spring_slope, linear=True, meaning="linear spring; always applied in full, it is not in the linear model"),
    Term("dashpot", "c*v", (Param("c", "N s/m", "coefficient", meaning="viscous damping that the linear model lacks"),),
         laws.dashpot, laws.dashpot_slope, linear=True, dissipative=True, meaning="linear viscous damper"),
)

_MEMORY = (
    Term("jenkins_memory", _JENKINS, (SLIP, STICK), laws.jenkins, laws.jenkins_slope, memory="masing",
         stiffness=laws.jenkins_stiffness, dissipative=True, meaning="elastic, perfectly plastic slider: parallelogram loop",
         source="Jenkins 1962; Masing 1926"),
    Term("iwan4_memory", _IWAN4, (SLIP, STICK, CHI, BETA), laws.iwan4, laws.iwan4_slope, memory="masing",
         stiffness=laws.iwan4_stiffness, dissipative=True,
         meaning="four-parameter Iwan element with its hysteresis loop: micro-slip damping", source="Segalman 2005; Masing 1926"),
    Term("iwan5_memory", _IWAN5, (SLIP, STICK, CHI, BETA, THETA), laws.iwan5, laws.iwan5_slope, memory="sliders",
         stiffness=laws.iwan5_stiffness, dissipative=True,
         meaning="five-parameter Iwan element as parallel sliders whose force drops to theta when they break loose; the loop depends on "
                 "history", source="Mignolet, Song and Wang 2015"),
    Term("bouc_wen", "alpha*q",
         (Param("alpha", "N/m", "stiffness", meaning="stiffness of the loop at its start"),
          Param("beta", "N^(1-nu)/m", "range", 1e-2, 1e8, "rate at which the loop bends; 1/m if nu = 1"),
          Param("gamma", "", "range", 0.0, 2.0, "share of the bending that dissipates"),
          Param("delta", "", "range", -2.0, 2.0, "share of the bending that does not"),
          Param("nu", "", "range", 1.0, 5.0, "sharpness of the knee")),
         laws.bouc_wen_start, laws.bouc_wen_start_slope, memory="bouc_wen", stiffness=laws.bouc_wen_stiffness, dissipative=True,
         meaning="Bouc–Wen force z with z' = alpha v - beta (gamma |v| |z|^(nu-1) z + delta v |z|^nu); formula shows its elastic start",
         source="Noël and Schoukens 2016, Bouc–Wen benchmark"),
)

LIBRARY: dict[str, Term] = {term.name: term for term in TABLE_1 + _BESIDE + _MEMORY}


def find_term(key: str | int, where: str = "term") -> Term:
    """A term by its name in the library or its number in Table 1.

    Parameters
    ----------
    key : str or int
        ``"iwan4"``, ``45`` or ``"45"``.
    where : str
        File and field, for the error.

    Returns
    -------
    Term

    Raises
    ------
    InputError
        If there is no such term.
    """
    text = str(key).strip()
    if text in LIBRARY:
        return LIBRARY[text]
    if text.isdigit() and 1 <= int(text) <= len(TABLE_1):
        return TABLE_1[int(text) - 1]
    raise InputError(where, f"there is no force law {text!r}",
                     f"use a number from 1 to {len(TABLE_1)} or a name that `nlsid terms` lists, such as iwan4, cubic or jenkins_memory")


def library_rows() -> list[dict[str, str]]:
    """The library as a table: one row for each term, all cells text.

    Returns
    -------
    list of dict
        Keys ``index``, ``name``, ``formula``, ``parameters`` (``name [unit]; …``), ``bounds``, ``memory``, ``parity``,
        ``dissipates``, ``confidence``, ``meaning``, ``source``.
    """
    rows = []
    for term in LIBRARY.values():
        bounds = (f"{p.lower:g} to {p.upper:g}" if p.rule == "range" else p.rule for p in term.params)
        rows.append({
            "index": "" if term.index is None else str(term.index),
            "name": term.name,
            "formula": term.formula,
            "parameters": "; ".join(f"{p.name} [{p.unit or '-'}]" for p in term.params),
            "bounds": "; ".join(f"{p.name}: {bound}" for p, bound in zip(term.params, bounds, strict=True)),
            "memory": term.memory,
            "parity": term.parity,
            "dissipates": "yes" if term.dissipative else "no",
            "confidence": term.confidence,
            "meaning": term.meaning,
            "source": term.source,
        })
    return rows
