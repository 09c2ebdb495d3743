"""Score diagnoses against answers: every figure of the "Reach" table, with Wilson intervals."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

BINS = (0.01, 0.03, 0.1, 0.3)
WAVES = ("nonlinear", "clipping")
FLOOR = 1e-4  # a stated probability below this counts as this in the log loss
GAIN_FLOOR = 1.15  # sealed error over noise from which there is something to remove


@dataclass(frozen=True)
class Scored:
    """One case: the answer, and what the tool said in comparable form."""

    name: str
    truth: tuple[str, ...]
    places: tuple[str, ...]
    strength: float
    group: str
    answer: dict[str, Any]
    p: float
    verdict: str
    said: tuple[str, ...]
    said_places: tuple[str, ...]
    confidence: float
    p_truth: float
    ranking: tuple[str, ...]
    stated_set: tuple[str, ...]
    seconds: float
    missing: bool
    sealed: tuple[dict[str, float], ...]
    own: dict[str, Any]

    @property
    def single(self) -> bool:
        return len(self.truth) == 1

    @property
    def null(self) -> bool:
        return not self.truth

    @property
    def right(self) -> bool:
        return self.said == self.truth

    @property
    def excused(self) -> bool:
        return bool(self.answer["inside_tolerances"]) and self.verdict == "cannot_tell"

    @property
    def bin(self) -> float:
        """Nearest of the nominal strengths in the logarithm."""
        return min(BINS, key=lambda b: abs(np.log(b / max(self.strength, 1e-9))))


def wilson(hits: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """95 % Wilson score interval of a proportion."""
    if n == 0:
        return 0.0, 1.0
    p = hits / n
    middle, half = (p + z * z / (2 * n)) / (1 + z * z / n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def rate(flags: Iterable[bool]) -> dict[str, float]:
    """Proportion with its interval and count."""
    values = list(flags)
    hits = int(sum(values))
    low, high = wilson(hits, len(values))
    return {"value": hits / len(values) if values else float("nan"), "low": low, "high": high, "hits": hits, "n": len(values)}


def classes_of(hypothesis: dict[str, Any]) -> tuple[str, ...]:
    """Sorted class names of a hypothesis; ``none`` is the empty tuple."""
    return tuple(sorted(e["class"] for e in hypothesis.get("effects", []) if e["class"] != "none"))


def read_case(answer_file: Path, results: Path) -> Scored:
    """One case from its answer and the tool's folder; a case without an answer counts as "nothing found"."""
    answer = json.loads(answer_file.read_text())
    folder = results / answer["case"]
    effects = answer["effects"]
    truth = tuple(sorted(e["cls"] for e in effects))
    places = tuple(e["loc"] for e in effects)
    strength = max((e["strength"] for e in effects), default=0.0)
    groups = {e["group"] for e in effects}
    group = "none" if not effects else "double" if len(effects) > 1 else groups.pop()
    if not (folder / "diagnosis.json").exists():
        return Scored(
            answer["case"],
            truth,
            places,
            strength,
            group,
            answer,
            0.0,
            "missing",
            (),
            (),
            1.0,
            1.0 if not truth else 0.0,
            (),
            (),
            float("nan"),
            True,
            (),
            {},
        )
    d = json.loads((folder / "diagnosis.json").read_text())
    mass: dict[tuple[str, ...], float] = defaultdict(float)
    for h in d["hypotheses"]:
        mass[classes_of(h)] += float(h["probability"])
    top = d["hypotheses"][0]
    said = classes_of(top)
    ranked = d.get("where", {}).get("locations", [])
    stated = (ranked[0]["name"], *ranked[0].get("indistinguishable_from", [])) if ranked else ()
    return Scored(
        answer["case"],
        truth,
        places,
        strength,
        group,
        answer,
        float(d["p_mismatch"]),
        d["verdict"],
        said,
        tuple(e.get("location", "-") for e in top.get("effects", [])),
        mass[said],
        mass.get(truth, 0.0),
        tuple(x["name"] for x in ranked),
        tuple(stated),
        float(d.get("seconds", float("nan"))),
        False,
        tuple(_sealed(answer_file.with_name(f"{answer['case']}_sealed.npz"), folder / "predictions.npz")),
        d.get("heldout", {}),
    )


def _sealed(truth_file: Path, prediction_file: Path) -> list[dict[str, float]]:
    """Per sealed record: mean squared errors of extended and linear predictions, noise, coverage of the 90 % band."""
    if not (truth_file.exists() and prediction_file.exists()):
        return []
    out = []
    with np.load(truth_file) as t, np.load(prediction_file) as p:
        for key in [k[:-6] for k in t.files if k.endswith("_accel")]:
            if f"{key}_accel_q50" not in p.files:
                continue
            y = t[f"{key}_accel"].astype(float)
            row = {
                "size": float(np.mean(y**2)),
                "noise": float(np.mean((t[f"{key}_clean"] - y) ** 2)),
                "linear": float(np.mean((t[f"{key}_linear"] - y) ** 2)),
                "extended": float(np.mean((p[f"{key}_accel_q50"] - y) ** 2)),
            }
            if f"{key}_accel_linear" in p.files:
                row["own_linear"] = float(np.mean((p[f"{key}_accel_linear"] - y) ** 2))
            if f"{key}_accel_q05" in p.files:
                row["coverage"] = float(np.mean((y >= p[f"{key}_accel_q05"]) & (y <= p[f"{key}_accel_q95"])))
            out.append(row)
    return out


def threshold(cases: Sequence[Scored], false_alarms: float = 0.05) -> float:
    """Largest score so many nulls reach: a case is detected when its ``p_mismatch`` lies above it."""
    nulls = np.sort([c.p for c in cases if c.null])[::-1]
    return float(nulls[int(np.floor(false_alarms * nulls.size))]) if nulls.size else 0.5


def detection(cases: Sequence[Scored]) -> dict[str, Any]:
    """Power at 5 % false alarms and false alarms at p > 0.5; ``cannot_tell`` passes where tolerances provably hide the effect."""
    at = threshold(cases)
    present = [c for c in cases if not c.null]

    def power(keep: Callable[[Scored], bool]) -> dict[str, float]:
        return rate(c.p > at or c.excused for c in present if keep(c))

    def audible(c: Scored) -> bool:
        return c.group == "nonlinear" or c.truth == ("clipping",)

    groups = sorted({c.group for c in present})
    return {
        "threshold": at,
        "auc": auc(cases),
        "false_alarms_p50": rate(c.p > 0.5 for c in cases if c.null),
        "power_p50": rate(c.p > 0.5 for c in present),
        "power": power(lambda c: True),
        "power_3": power(lambda c: c.bin >= 0.03),
        "power_1": power(lambda c: c.bin < 0.03),
        "nonlinear_3": power(lambda c: audible(c) and c.bin >= 0.03),
        "nonlinear_1": power(lambda c: audible(c) and c.bin < 0.03),
        "by_group": {g: {str(b): power(lambda c, g=g, b=b: c.group == g and c.bin == b) for b in BINS} for g in groups},
        "by_conceal": {
            str(k): power(lambda c, k=k: c.answer["conceal"] == k) for k in sorted({str(c.answer["conceal"]) for c in present} - {"None"})
        },
        "inside_tolerances": sum(bool(c.answer["inside_tolerances"]) for c in present),
        "excused": sum(c.excused for c in present),
    }


def auc(cases: Sequence[Scored]) -> float:
    """Probability that a case with an effect scores above one without (ties count half)."""
    null = np.array([c.p for c in cases if c.null])
    there = np.array([c.p for c in cases if not c.null])
    if not (null.size and there.size):
        return float("nan")
    gap = there[:, None] - null[None, :]
    return float(np.mean((gap > 0) + 0.5 * (gap == 0)))


def naming(cases: Sequence[Scored]) -> dict[str, Any]:
    """Class of singles, per class, doubles, confusion, and what happens outside the catalogue."""
    singles = [c for c in cases if c.single]
    doubles = [c for c in cases if len(c.truth) == 2]
    confusion: dict[str, Counter[str]] = defaultdict(Counter)
    for c in cases:
        if len(c.truth) < 2:
            confusion[c.truth[0] if c.truth else "none"]["+".join(c.said) or "none"] += 1
    outside = [c for c in singles if c.truth == ("other",)]
    return {
        "singles_3": rate(c.right for c in singles if c.bin >= 0.03),
        "singles_all": rate(c.right for c in singles),
        "contains_3": rate(c.truth[0] in c.said for c in singles if c.bin >= 0.03),
        "by_strength": {str(b): rate(c.right for c in singles if c.bin == b) for b in BINS},
        "by_class": {k: rate(c.right for c in singles if c.truth == (k,) and c.bin >= 0.03) for k in sorted({c.truth[0] for c in singles})},
        "double_named": rate(cls in c.said for c in doubles for cls in c.truth),
        "double_placed": rate(place in c.said_places or place in c.ranking[:2] for c in doubles for place in c.places),
        "confident_and_wrong": rate(bool(c.said) and not c.right and c.confidence > 0.9 for c in cases),
        "confident_miss": rate(not c.said and not c.right and c.confidence > 0.9 for c in cases if not c.missing),
        "outside": rate(c.said == ("other",) or c.verdict == "cannot_tell" for c in outside),
        "confusion": {k: dict(v) for k, v in sorted(confusion.items())},
    }


def placing(cases: Sequence[Scored]) -> dict[str, Any]:
    """Place of detected singles: exact, in the set the tool states, in the set the truth gives, among the first three."""
    at = threshold(cases)
    found = [c for c in cases if c.single and c.p > at and c.places[0] != "-"]

    def alike(c: Scored) -> list[str]:
        return c.answer["equivalent_locations"].get(c.places[0], {}).get("same_by_noise", [])

    def first(c: Scored) -> str:
        return c.ranking[0] if c.ranking else (c.said_places[0] if c.said_places else "")

    table = {}
    for name, keep in (
        ("all", lambda c: True),
        ("nonlinear", lambda c: c.group == "nonlinear"),
        ("rest", lambda c: c.group != "nonlinear"),
    ):
        some = [c for c in found if keep(c)]
        table[name] = {
            "exact": rate(first(c) == c.places[0] for c in some),
            "stated_set": rate(c.places[0] in c.stated_set or first(c) == c.places[0] for c in some),
            "true_set": rate(first(c) == c.places[0] or first(c) in alike(c) for c in some),
            "top3": rate(c.places[0] in c.ranking[:3] for c in some),
            "hypothesis": rate(c.places[0] in c.said_places for c in some),
        }
    table["median_stated_set"] = float(np.median([len(c.stated_set) for c in found])) if found else float("nan")
    return table


def calibration(cases: Sequence[Scored]) -> dict[str, Any]:
    """Expected calibration error of the first answer (ten equal bins), log loss of the truth, reliability table."""
    confidence = np.array([c.confidence for c in cases])
    right = np.array([c.right for c in cases], float)
    edges = np.clip((confidence * 10).astype(int), 0, 9)
    rows, error = [], 0.0
    for b in range(10):
        inside = edges == b
        if inside.any():
            rows.append([b / 10, int(inside.sum()), float(confidence[inside].mean()), float(right[inside].mean())])
            error += inside.mean() * abs(confidence[inside].mean() - right[inside].mean())
    loss = -np.log(np.clip([c.p_truth for c in cases], FLOOR, 1.0))
    return {
        "ece": float(error),
        "log_loss": float(loss.mean()),
        "mean_confidence": float(confidence.mean()),
        "accuracy": float(right.mean()),
        "reliability": rows,
    }


def proof(cases: Sequence[Scored]) -> dict[str, Any]:
    """Sealed records: excess error energy removed against the best linear re-tuning, made worse, coverage."""

    def removed(keep: Callable[[Scored], bool]) -> dict[str, float]:
        values = [
            1.0 - (r["extended"] - r["noise"]) / (r["linear"] - r["noise"])
            for c in cases
            if keep(c)
            for r in c.sealed
            if r["linear"] > GAIN_FLOOR**2 * r["noise"]
        ]
        if not values:
            return {"median": float("nan"), "q25": float("nan"), "q75": float("nan"), "n": 0}
        q = np.quantile(values, [0.25, 0.5, 0.75])
        return {"q25": float(q[0]), "median": float(q[1]), "q75": float(q[2]), "n": len(values)}

    def worse(keep: Callable[[Scored], bool], rival: str) -> dict[str, float]:
        return rate(np.sqrt(r["extended"]) > 1.02 * np.sqrt(r[rival]) for c in cases if keep(c) for r in c.sealed if rival in r)

    own = [c.own for c in cases if {"nrmse_extended", "nrmse_updated_linear"} <= set(c.own)]
    covered = [r["coverage"] for c in cases for r in c.sealed if "coverage" in r]
    steady_groups = ("linear", "input", "sensor")
    return {
        "nonlinear": {str(b): removed(lambda c, b=b: c.single and c.group == "nonlinear" and c.bin == b) for b in BINS},
        "nonlinear_1_3": removed(lambda c: c.single and c.group == "nonlinear" and c.bin <= 0.03),
        "linear_input_sensor": removed(lambda c: c.single and c.group in steady_groups),
        "double": removed(lambda c: len(c.truth) == 2),
        "worse": worse(lambda c: True, "linear"),
        "worse_null": worse(lambda c: c.null, "linear"),
        "worse_own": worse(lambda c: True, "own_linear"),
        "worse_own_null": worse(lambda c: c.null, "own_linear"),
        "worse_stated": rate(h["nrmse_extended"] > 1.02 * h["nrmse_updated_linear"] for h in own),
        "coverage_mean": float(np.mean(covered)) if covered else float("nan"),
        "coverage_ok": rate(0.85 <= x <= 0.95 for x in covered),
    }


def figures(cases: Sequence[Scored]) -> dict[str, Any]:
    """All figures; the normal and the hard tier are also given apart."""
    hard = [c for c in cases if c.answer["tier"] == "hard"]
    kinds = {"burst_only": [c for c in hard if c.answer["burst_only"]], "four_sensors": [c for c in hard if c.answer["few_sensors"]]}
    seconds = [c.seconds for c in cases if np.isfinite(c.seconds)]
    return {
        "cases": len(cases),
        "nulls": sum(c.null for c in cases),
        "doubles": sum(len(c.truth) == 2 for c in cases),
        "without_answer": sum(c.missing for c in cases),
        "detection": detection(cases),
        "naming": naming(cases),
        "placing": placing(cases),
        "calibration": calibration(cases),
        "proof": proof(cases),
        "hard": {
            k: {
                "n": len(v),
                "named_10": rate(c.right for c in v if c.single and c.bin >= 0.1),
                "named": rate(c.right for c in v if c.single),
                "false_alarms_p50": rate(c.p > 0.5 for c in v if c.null),
                "power_p50": rate(c.p > 0.5 for c in v if not c.null),
            }
            for k, v in {"all": hard, **kinds}.items()
        },
        "normal_singles_3": rate(c.right for c in cases if c.single and c.bin >= 0.03 and c.answer["tier"] == "normal"),
        "seconds": {"median": float(np.median(seconds)), "max": float(np.max(seconds))} if seconds else {},
    }


def score_files(results: Path, answers: Path, out: Path) -> int:
    """Read, score, write ``out`` (.md) and the same figures as .json."""
    from .tables import markdown

    files = sorted(p for p in answers.glob("case_*.json"))
    cases = [read_case(f, results) for f in files]
    if not cases:
        print(f"{answers}: no answers (case_*.json)")
        return 2
    result = figures(cases)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".json").write_text(json.dumps(result, indent=1))
    out.with_suffix(".md").write_text(markdown(result))
    print(markdown(result))
    return 0
