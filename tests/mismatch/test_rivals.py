"""Which explanations stand beside each other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from bayes_nlsid.mismatch.disturb import Disturbance
from bayes_nlsid.mismatch.rivals import Rival, _disturbed


def test_a_disturbance_stands_beside_the_best_single_effect_even_where_a_pair_leads() -> None:
    law, drift = ("asymmetric", "TIP_w"), ("stiffness_drift", "TIP_w")
    rivals = [Rival((law, drift), 4000.0, 3800.0), Rival((law,), 3800.0, strengths=(0.2,)), Rival((drift,), 100.0)]
    record = SimpleNamespace(accel=np.ones((8, 2)))
    case: Any = SimpleNamespace(classes=("base_motion",), loudest=record, sensors=("S1", "S2"), usable=np.ones(2, dtype=bool))
    found = _disturbed([Disturbance("base_motion", "BASE", 900.0, 0.03)], rivals, case)
    pair = next(r for r in found if r.key == (law, ("base_motion", "BASE")))
    assert pair.gain == 4700.0 and pair.alone == 3800.0 and pair.strengths == (0.2, 0.03)
    assert pair.incoherent and not rivals[0].incoherent
    assert any(r.key == (("base_motion", "BASE"),) and r.gain == 900.0 for r in found)
    assert all((drift in r.key) == (r in rivals and drift in r.key) for r in found)
