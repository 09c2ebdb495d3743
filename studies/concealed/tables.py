"""The figures of a scored batch as Markdown."""

from __future__ import annotations

from typing import Any


def share(r: dict[str, float]) -> str:
    """A proportion as ``95 % [88, 98] (57/60)``."""
    if not r["n"]:
        return "–"
    return f"{100 * r['value']:.0f} % [{100 * r['low']:.0f}, {100 * r['high']:.0f}] ({r['hits']:.0f}/{r['n']:.0f})"


def spread(r: dict[str, float]) -> str:
    """A median with quartiles, as percentages."""
    return "–" if not r["n"] else f"{100 * r['median']:.0f} % [{100 * r['q25']:.0f}, {100 * r['q75']:.0f}] (n {r['n']})"


def markdown(f: dict[str, Any]) -> str:
    """All tables of one batch."""
    d, n, w, c, p = f["detection"], f["naming"], f["placing"], f["calibration"], f["proof"]
    rows = [
        ("false alarms at p > 0.5 on cases with nothing missing", share(d["false_alarms_p50"]), "≤ 4 %"),
        ("power at 5 % false alarms, nonlinear + time-varying + clipping, ≥ 3 %", share(d["nonlinear_3"]), "99 %"),
        ("the same at 1 %", share(d["nonlinear_1"]), "93 %"),
        ("power at 5 % false alarms, all classes, ≥ 3 %", share(d["power_3"]), "97 %"),
        ("the same at 1 %", share(d["power_1"]), "75 %"),
        ("power at p > 0.5, all", share(d["power_p50"]), ""),
        ("area under the detection curve", f"{d['auc']:.3f}", ""),
        ("class right, singles ≥ 3 %", share(n["singles_3"]), "93 %"),
        ("hysteresis ≥ 3 %", share(n["by_class"].get("hysteresis", {"n": 0})), "85 %"),
        ("clearance ≥ 3 %", share(n["by_class"].get("clearance", {"n": 0})), "85 %"),
        ("place exact (detected singles)", share(w["all"]["exact"]), "92 %"),
        (
            "place in the stated indistinguishable set",
            f"{share(w['all']['stated_set'])}, median set of {w['median_stated_set']:.0f}",
            "96 %",
        ),
        ("place in the set the truth cannot tell apart", share(w["all"]["true_set"]), ""),
        ("place among the first three", share(w["all"]["top3"]), ""),
        ("doubles: each effect named", share(n["double_named"]), "75 %"),
        ("doubles: each effect placed", share(n["double_placed"]), ""),
        ("expected calibration error", f"{c['ece']:.3f}", "≤ 0.05"),
        ("log loss", f"{c['log_loss']:.2f}", "≤ 0.6"),
        ("wrong name with p > 0.9", share(n["confident_and_wrong"]), "≤ 3 %"),
        ("nothing found with p > 0.9 though something is missing", share(n["confident_miss"]), ""),
        ("outside the catalogue called other or cannot tell", share(n["outside"]), "≥ 70 %"),
        ("excess energy removed, nonlinear 1–3 %", spread(p["nonlinear_1_3"]), "95 %"),
        ("the same at 10 %", spread(p["nonlinear"]["0.1"]), "90 %"),
        ("the same at 30 %", spread(p["nonlinear"]["0.3"]), "80 %"),
        ("the same, linear, input and sensor effects", spread(p["linear_input_sensor"]), "≥ 99 %"),
        ("the same, two effects", spread(p["double"]), ""),
        ("made worse by more than 2 % (against the answer sheet's linear fit)", share(p["worse"]), "≤ 1 %"),
        ("the same on nulls", share(p["worse_null"]), "0"),
        ("made worse by more than 2 % (against the tool's linear prediction, if given)", share(p["worse_own"]), "≤ 1 %"),
        ("the same on nulls", share(p["worse_own_null"]), "0"),
        ("made worse by the tool's own held-out figures", share(p["worse_stated"]), "≤ 1 %"),
        ("90 % bands covering 85–95 % of the samples", f"{share(p['coverage_ok'])}, mean {p['coverage_mean']:.2f}", "≥ 90 %"),
        ("hard tier, named at ≥ 10 %", share(f["hard"]["all"]["named_10"]), "≥ 70 %"),
        ("– bursts only", share(f["hard"]["burst_only"]["named_10"]), ""),
        ("– four sensors", share(f["hard"]["four_sensors"]["named_10"]), ""),
        (
            "seconds per case, median (longest)",
            f"{f['seconds'].get('median', float('nan')):.0f} ({f['seconds'].get('max', float('nan')):.0f})",
            "< 60",
        ),
    ]
    lines = [
        f"{f['cases']} cases: {f['nulls']} with nothing missing, {f['doubles']} with two effects; {f['without_answer']} without an answer. "
        f"Detection threshold p > {d['threshold']:.3g}; {d['inside_tolerances']} effects provably inside the tolerances, "
        f'{d["excused"]} of them answered "cannot tell". Brackets: 95 % Wilson intervals or quartiles.',
        "",
        "| what | measured | at least |",
        "|---|---|---|",
        *(f"| {a} | {b} | {g} |" for a, b, g in rows),
        "",
        "Detected at 5 % false alarms, by group and strength",
        "",
        "| group | 1 % | 3 % | 10 % | 30 % |",
        "|---|---|---|---|---|",
    ]
    lines += [f"| {g} | " + " | ".join(share(v) for v in by.values()) + " |" for g, by in d["by_group"].items()]
    lines += [
        "",
        "By concealment",
        "",
        "| concealment | detected |",
        "|---|---|",
        *(f"| {k} | {share(v)} |" for k, v in d["by_conceal"].items()),
    ]
    lines += [
        "",
        "Class right (single effects ≥ 3 %)",
        "",
        "| class | right |",
        "|---|---|",
        *(f"| {k} | {share(v)} |" for k, v in n["by_class"].items()),
        "",
        *confusion(n["confusion"]),
    ]
    lines += [
        "",
        "Stated against observed",
        "",
        "| confidence from | cases | stated | right |",
        "|---|---|---|---|",
        *(f"| {a:.1f} | {k} | {s:.2f} | {o:.2f} |" for a, k, s, o in c["reliability"]),
        "",
    ]
    return "\n".join(lines)


def confusion(table: dict[str, dict[str, int]]) -> list[str]:
    """Confusion of nulls and singles, one line per true class."""
    lines = ["Answers by true class (nulls and single effects, all strengths)", "", "| truth | answers |", "|---|---|"]
    for truth, said in table.items():
        ranked = sorted(said.items(), key=lambda item: (item[0] != truth, -item[1]))
        lines.append(
            f"| {truth} | " + ", ".join(f"{'**' if k == truth else ''}{k}{'**' if k == truth else ''} {v}" for k, v in ranked) + " |"
        )
    return lines
