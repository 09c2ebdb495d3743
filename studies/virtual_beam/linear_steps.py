"""Linear part of the study: Table 2 and Fig. 4 (frequencies, shapes, reductions), Tables 5 and 6 (updating)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from studies.virtual_beam import beam, figures
from studies.virtual_beam.beam import MASTERS, SLIP, TABLE_2, Array, Solid
from studies.virtual_beam.study import Book

from bayes_nlsid.structure.bases import attachment_modes, craig_bampton, serep
from bayes_nlsid.structure.identified import IdentifiedModes
from bayes_nlsid.structure.reduction import Reduced, iirs
from bayes_nlsid.structure.solid_beam import solid_beam
from bayes_nlsid.structure.structure import mac, modes
from bayes_nlsid.structure.updating import Updated, update

TABLE_6 = np.array([81.068, 281.83, 509.34, 832.97])
TABLE_5_E = 184.085e9
TABLE_5_Z = np.array([1.70582e8, 9.57534e7, 1.44823e8])
TABLE_5_Y = np.array([1.95676e9, 6.44018e9, 4.41949e10])
"""Exponents of Y are damaged in the scan; frequencies do not depend on them from 1e9 upwards."""
SEVEN = {"E": ("E",), **{f"{d} joints {i + 1}{f' = {5 - i}' if i < 2 else ''}": tuple(f"J{j}_{s}" for j in sorted({i + 1, 5 - i}))
                         for d, s in (("Y", "open"), ("Z", "slip")) for i in range(3)}}


def frequencies(book: Book, solid: Solid) -> None:
    """Table 2: ten frequencies, with the one number that was updated and without."""
    error = solid.table / TABLE_2 - 1
    book.numbers |= {"table 2 worst": float(np.abs(error).max()), "table 2 mode 1": float(error[0])}
    raw = beam.build(replace(solid.beam, E=beam.PRINTED_E))
    unbound = beam.build(replace(solid.beam, E=beam.PRINTED_E, rigid_washers=False))
    part = "Table 2: natural frequencies, Hz"
    for i in range(10):
        here = f"{solid.table[i]:.2f} ({100 * error[i]:+.2f} %)"
        other = f"E = 200 GPa: {100 * (raw.table[i] / TABLE_2[i] - 1):+.2f} %; and washers without stiffness: " \
                f"{100 * (unbound.table[i] / TABLE_2[i] - 1):+.2f} %"
        book.add(part, f"mode {i + 1}", f"{TABLE_2[i]:.2f}", here, other)
    book.notes.append(f"Solid model: {solid.structure.notes[0]}. E is updated from the printed 200 to {solid.beam.E / 1e9:g} GPa, washer "
                      f"footprints of {1e3 * solid.beam.washer:g} mm radius are rigid (the paper does not say how bolts are attached). The "
                      f"paper's list leaves out a clean bending mode, here at {solid.found.frequency[beam.SKIPPED]:.0f} Hz.")


def reductions(book: Book, solid: Solid) -> dict[str, Reduced]:
    """ROM1 by iterations, ROM2 from twelve points, and what each basis loses at the joints."""
    structure = solid.structure
    rom1 = iirs(structure, MASTERS, iterations=book.settings.pick(6, 3), tolerance=1e-9)
    rom2 = iirs(structure, MASTERS[:12], iterations=book.settings.pick(15, 5), tolerance=1e-9, guard="constrain")
    found = {"ROM1": iirs(structure, MASTERS, iterations=1, tolerance=1e-9), "ROM1, all iterations": rom1, "ROM2": rom2,
             "SEREP": serep(structure, MASTERS, 13), "Craig-Bampton": craig_bampton(structure, MASTERS, 20),
             "modes": attachment_modes(structure, 12, at=()), "attachment": attachment_modes(structure, 12, at=SLIP, rigid=False)}
    part = "Table 2: error of reduced models, % (worst of the ten lowest elastic modes)"
    for count, step in enumerate(rom1.history):
        lost = dict(zip(structure.joints, step.joint_loss, strict=True))
        paper = "0.24 (mode 9), 0.03 elsewhere" if count == 1 else ""
        book.add(part, f"IIRS, 32 masters, iteration {count}", paper, f"{100 * step.worst:.2g}, least MAC {step.mac.min():.6f}",
                 f"joint flexibility lost: outer {100 * lost['J1_slip']:.1f} %, inner {100 * lost['J2_slip']:.1f} %, middle "
                 f"{100 * lost['J3_slip']:.1f} %")
    for count in sorted({0, 5, 10, len(rom2.history) - 1} & set(range(len(rom2.history)))):
        book.add(part, f"IIRS, 12 masters, iteration {count}", "", f"{100 * rom2.history[count].worst:.2g}", "")
    for name in ("SEREP", "Craig-Bampton", "modes", "attachment"):
        step = found[name].history[-1]
        lost = dict(zip(structure.joints, step.joint_loss, strict=True))
        book.add(part, found[name].method, "", f"{100 * step.worst:.2g}", f"joint flexibility lost: outer {100 * lost['J1_slip']:.2g} %, "
                 f"inner {100 * lost['J2_slip']:.2g} %, middle {100 * lost['J3_slip']:.2g} %")
    book.numbers |= {"iirs worst at 1": rom1.history[1].worst, "attachment loss": float(_slip_loss(found["attachment"]).max()),
                     "modes loss": float(_slip_loss(found["modes"]).min())}
    points = structure.rows([f"P{i}" for i in range(1, 13)])
    likeness = np.diag(mac(points @ solid.found.shapes[:, :10], points @ found["ROM1"].modes(10).shapes))
    book.numbers["mac at points"] = float(likeness.min())
    figures.shapes(book.figure("fig04_modes"), solid)
    others = {name: found[name] for name in ("SEREP", "Craig-Bampton", "modes", "attachment")}
    figures.iterations(book.figure("fig04_iterations"), rom1, rom2, others)
    return found


def _slip_loss(reduced: Reduced) -> Array:
    joints = list(reduced.structure.joints)
    return reduced.history[-1].joint_loss[[joints.index(n) for n in SLIP]]


def updating(book: Book, solid: Solid) -> Updated:
    """Tables 5 and 6 on modal data of a beam with known E and springs: how well seven variables come back."""
    rng = np.random.default_rng(book.settings.seed)
    z, y = TABLE_5_Z[[0, 1, 2, 1, 0]], TABLE_5_Y[[0, 1, 2, 1, 0]]
    # The common factor of Table 2 is kept, so that the plant has the frequencies of Table 6.
    scale = solid.beam.E / beam.PRINTED_E
    plant = solid_beam(replace(solid.beam, E=TABLE_5_E * scale, normal=tuple(y), tangential=tuple(z)))
    found = modes(plant, 8)
    part = "Table 6: frequencies with the springs of Table 5, Hz"
    for i in range(4):
        book.add(part, f"mode {i + 1}", f"{TABLE_6[i]}", f"{found.frequency[i]:.3f} ({100 * (found.frequency[i] / TABLE_6[i] - 1):+.2f} %)")
    book.numbers["table 6 worst"] = float(np.abs(found.frequency[:4] / TABLE_6 - 1).max())
    points = tuple(f"P{i}" for i in range(1, 13))
    error = 2e-4
    measured = found.frequency * (1 + error * rng.normal(size=8))
    shapes = plant.rows(points) @ found.shapes
    shapes = shapes / np.abs(shapes).max(axis=0) + 0.002 * rng.normal(size=shapes.shape)
    data = IdentifiedModes(measured, np.full(8, 1e-3), shapes, points, points, tuple(range(8)), error * measured, np.full(8, 1e-4),
                           np.full(shapes.shape, 0.002), np.zeros(8), np.full(8, 1e-6), ((0.0, 1.0),) * 8, ("ok",) * 8)
    start = solid_beam(replace(solid.beam, E=beam.PRINTED_E * scale, normal=3e9, tangential=1e8))
    result = update(start, SEVEN, data, frequency_error=0.0, prior_sd={**dict.fromkeys(SEVEN, 1.5), "E": 0.1})
    truths = np.array([TABLE_5_E * scale, *TABLE_5_Y, *TABLE_5_Z])
    begun = np.array([beam.PRINTED_E * scale, 3e9, 3e9, 3e9, 1e8, 1e8, 1e8])
    part = "Table 5: seven log-scaled variables from eight measured frequencies (0.02 %), GPa and N/m"
    for name, true, value, sd, unit in zip(result.names, truths, begun * result.values, result.sd, [1e9] + [1.0] * 6, strict=True):
        book.add(part, name, f"truth of the plant {true / unit:.4g}", f"{value / unit:.4g}",
                 f"{value / unit * np.exp(-1.645 * sd):.4g} – {value / unit * np.exp(1.645 * sd):.4g}"
                 + (" (next to nothing learned)" if name in result.unidentifiable else ""))
    z_scores = (np.log(begun * result.values) - np.log(truths)) / result.sd
    book.numbers |= {"updating worst z": float(np.abs(z_scores).max()), "updating E": float(begun[0] * result.values[0] / truths[0] - 1)}
    book.notes.append("Updating: " + result.status)
    figures.updated(book.figure("table05_updating"), result, truths / begun)
    return result
