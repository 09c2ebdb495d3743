"""Fig. 5 (backbones of reduced models), Fig. 6 (tests and virtual sensing), Tables 3 and 4 and Fig. 7 (fits, posteriors, force maps)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from studies.virtual_beam import analyst, beam, figures, plants, truth
from studies.virtual_beam.analyst import Fitted, Sensing
from studies.virtual_beam.beam import SLIP, TIP, ZETA, Array, Solid
from studies.virtual_beam.study import Book
from studies.virtual_beam.table import span

import bayes_nlsid as nl
from bayes_nlsid.inference.likelihood import WhittleLikelihood
from bayes_nlsid.recordings.noise import NoiseFloor
from bayes_nlsid.recordings.recording import Recording
from bayes_nlsid.structure.bases import attachment_modes
from bayes_nlsid.structure.modal import ModalData, ModalModel
from bayes_nlsid.structure.modal_model import modal_model
from bayes_nlsid.structure.reduction import Reduced

NOISE = 0.01    # m/s² rms at 8192 Hz: about 1 mg
TRUE_THETA = np.tile([beam.F_S, beam.CHI, beam.BETA], len(SLIP))


@dataclass(frozen=True)
class Models:
    """Modal models of one beam: twelve modes (what the plant is exported from), ten, and twelve with attachment modes."""

    twelve: ModalModel
    ten: ModalModel
    rich: ModalModel
    reduced: dict[str, Reduced]

    @property
    def start(self) -> Array:
        """Theta of the truth."""
        return np.concatenate([[self.twelve.frequency[0], ZETA], TRUE_THETA])

    def law(self, model: ModalModel, term: str = "iwan4") -> nl.Model:
        """Iwan elements on a modal model, mode 1 free."""
        return nl.Model(model, (nl.Element(nl.LIBRARY[term], SLIP, fixed=(("k_t", beam.K_T),)),), (0,))


def models_of(solid: Solid, reduced: dict[str, Reduced]) -> Models:
    """Modal models from the solid one."""
    twelve = modal_model(solid.structure, 12, zeta=ZETA)
    rich = attachment_modes(solid.structure, 12, at=SLIP, rigid=False)
    damping = np.full(rich.size, ZETA)
    damping[12:] = 0.01     # attachment modes, 8 kHz and more, stand for statics
    return Models(twelve, twelve.take(range(10)), modal_model(rich, rich.size, zeta=damping), reduced)


def backbones(book: Book, models: Models) -> None:
    """Fig. 5: released from mode 1 with 4 mm at the tip, by averaging, and by the plant's own integrator."""
    first = models.reduced["ROM1"]
    roms = {"ROM1 (29 modes)": modal_model(first, 29, zeta=ZETA), "ROM2 (12 masters)": modal_model(models.reduced["ROM2"], 9, zeta=ZETA),
            "ROM3 (1 mode)": models.twelve.take([0]), "ROM4 (12 modes)": modal_model(first, 12, zeta=ZETA),
            "12 + 5 attachment modes": models.rich}
    grid = np.geomspace(1e-4, 3.9e-3, 40)
    found: dict[str, dict[str, nl.Bands]] = {}
    for kind, term in (("static", "iwan4"), ("memory", "iwan4_memory")):
        found[kind] = {}
        for name, rom in roms.items():
            theta = np.concatenate([[rom.frequency[0], ZETA], TRUE_THETA])
            found[kind][name] = _averaged(models.law(rom, term), theta, grid)
    plant = plants.export(models.twelve)
    checks = {kind: _decay(plant, kind, book.settings.pick(4, 1)) for kind in ("static", "memory")}
    part = "Fig. 5: backbones, frequency (Hz) and damping ratio (%) at 3.9, 1 and 0.1 mm of the tip"
    for kind, curves in found.items():
        paper = "about 77 to 78.5 Hz, damping 0.02 to 0.06" if kind == "static" else ""
        for name, b in curves.items():
            at = [int(np.argmin(np.abs(np.log(grid / a)))) for a in (3.9e-3, 1e-3, 1e-4)]
            book.add(part, f"{kind}, {name}", paper, ", ".join(f"{b.frequency[1][i]:.2f}" for i in at),
                     ", ".join(f"{100 * b.damping[1][i]:.3f}" for i in at))
    rich = found["static"]["12 + 5 attachment modes"]
    check = checks["static"]
    inside = (check.amplitude > 1.2e-4) & (check.amplitude < 3.7e-3) & np.isfinite(check.frequency)
    off = np.interp(check.amplitude[inside], grid, rich.frequency[1]) - check.frequency[inside]
    book.numbers |= {"backbone static against plant, Hz": float(np.abs(off).max()),
                     "rom4 against rich at 3.9 mm, Hz": float(found["static"]["ROM4 (12 modes)"].frequency[1][-1] - rich.frequency[1][-1]),
                     "memory damping at 1 mm": float(np.interp(1e-3, grid, found["memory"]["12 + 5 attachment modes"].damping[1])),
                     "static damping at 1 mm": float(np.interp(1e-3, grid, rich.damping[1]))}
    book.add(part, "averaging against the plant's own integrator, static", "", f"largest difference {np.abs(off).max():.3f} Hz")
    figures.backbones(book.figure("fig05_backbones"), found, checks)


def _averaged(model: nl.Model, theta: Array, grid: Array) -> nl.Bands:
    from bayes_nlsid.prediction.fast import fast_bands

    return fast_bands(theta, model, at=TIP, start_amplitude=4e-3, amplitudes=grid)


def _decay(plant: truth.Plant, kind: str, seconds: float) -> nl.Backbone:
    fs = 8192.0
    joint = truth.Joint.of(plants.true_joints())
    law = truth.Static(joint, 1) if kind == "static" else truth.Memory(joint, 1)
    u0 = np.zeros((1, len(plant.omega)))
    u0[0, 0] = 4e-3 / plant.sensors[-1, 0]
    motion = truth.integrate(plant, law, np.zeros((round(seconds * fs), 1)), 1 / fs, u0=u0)
    return nl.measured_backbone(motion.time, motion.x[:, 0, -1], band=(40.0, 140.0))


@dataclass(frozen=True)
class Recorded:
    """The three virtual tests as recorded, and what the analyst makes of the first."""

    tests: plants.Tests
    records: tuple[Recording, ...]
    floors: tuple[NoiseFloor, ...]
    data: ModalData
    windows: dict[str, tuple[float, float]]


def record(book: Book, models: Models, memory: bool = False) -> Recorded:
    """Fig. 6a: sweep and decay at 40 N for training, at 30 N and near mode 2 for validation."""
    fast = book.settings.fast
    shaken, total = (4.0, 6.0) if fast else (16.0, 20.0)
    # The shorter sweep of the fast variant is louder, so that the outer joints reach macroslip all the same.
    tests = plants.run(plants.export(models.twelve), shaken, total, analyst.RATE, memory=memory, louder=1.3 if fast else 1.0)
    roles = ("train", "holdout", "holdout")
    made = [analyst.recording(name, tests.acceleration[:, i], tests.force[:, i], NOISE, plants.RAW, book.settings.seed + i, roles[i])
            for i, name in enumerate(plants.sweeps((78.56, 288.84)))]
    data = analyst.observe(made[0][0], made[0][1], models.ten)
    windows = {"start": (0.3, 2.3), "near resonance": (shaken - 2.0, shaken), "decay": (shaken + 0.1, shaken + (1.5 if fast else 2.1))}
    return Recorded(tests, tuple(r for r, _ in made), tuple(n for _, n in made), data, windows)


def sensing(book: Book, models: Models, recorded: Recorded) -> nl.Fit:
    """Fig. 6b: motion of the joints by three routes. Returns the common law that route (iii) needs."""
    data, tests = recorded.data, recorded.tests
    law, change = analyst.common_law(models.ten, data, recorded.windows, rounds=20, starts=book.settings.pick(8, 4),
                                     seed=book.settings.seed)
    book.numbers["common law change"] = change
    rom = modal_model(models.reduced["ROM1"], 12, zeta=ZETA).take(range(10))
    through = analyst.observe(recorded.records[0], recorded.floors[0], rom)
    own = Sensing(models.ten)
    corrected = own.corrected(data, own.force_of(data, analyst.common_values(law.theta)))
    routes = {"(i) full-order mode shapes": data, "(ii) mode shapes through IIRS": through,
              "(iii) and the joints' own flexibility": corrected}
    part = "Fig. 6: virtual sensing, rms error of joint displacement, % (outer, inner)"
    valid = slice(round(0.3 / data.dt), round((recorded.tests.seconds + 1.5) / data.dt))
    for name, route in routes.items():
        miss = np.sqrt(np.mean((route.q[valid] - tests.q[valid, 0]) ** 2, axis=0) / np.mean(tests.q[valid, 0] ** 2, axis=0))
        paper = {"(i)": "worse than (ii)", "(ii)": "better than (i)"}.get(name.split()[0], "")
        book.add(part, name, paper, f"{100 * miss[0]:.2f}, {100 * miss[1]:.2f}")
        book.numbers[f"sensing {name.split(')')[0]})"] = float(miss[0])
    book.add(part, "common law that route (iii) needs: f_s, χ, β", "", ", ".join(f"{x:.4g}" for x in law.theta[2:]),
             f"last round changed the forces by {100 * change:.2g} %")
    middle = 1e9 * np.array([np.abs(tests.q[valid, 0, 2]).max(), np.abs(corrected.q[valid, 2]).max()])
    book.add(part, "middle joint: largest motion, and what is sensed there, nm", "", f"{middle[0]:.2g}, {middle[1]:.2g}",
             "what is sensed there is error: nothing can be said of this joint")
    book.numbers["middle joint sensed over true"] = float(middle[1] / middle[0])
    book.add(part, "largest outer joint displacement over that of macroslip", "", f"{tests.slip[0].max():.2f}")
    book.add(part, "largest tip displacement, mm", "4", f"{1e3 * np.abs(tests.tip[:, 0]).max():.2f}")
    figures.tests(book.figure("fig06a_tests"), recorded.tests, recorded.windows)
    figures.sensing(book.figure("fig06b_sensing"), tests, routes, data.dt, recorded.windows["near resonance"])
    return law


def algebra(book: Book, models: Models) -> None:
    """The inverse crime, on purpose: ten modes, exact modal motion, no noise. Whatever is not recovered is the algebra's fault."""
    plant = plants.export(models.ten).truncated(10)
    fs, fine = 2048.0, 8192.0
    f = plant.omega / (2 * np.pi)
    seconds = 3.0
    force = np.stack([truth.sweep(f[0] - 0.6, f[0] - 2.1, 2.5, seconds, 40.0, fine),
                      truth.sweep(f[1] + 1.2, f[1] - 0.8, 1.5, seconds, 100.0, fine)], axis=1)
    # With mode 2 in the game the outer joints move differently; in mode 1 alone nothing tells one from the other.
    u0 = np.zeros((2, 10))
    u0[:, 0], u0[:, 1] = 4.2e-3 / plant.sensors[-1, 0], [1e-3 / plant.sensors[-1, 1], -1e-3 / plant.sensors[-1, 1]]
    motion = truth.integrate(plant, truth.Static(truth.Joint.of(plants.true_joints()), 2), force, 1 / fine, u0=u0, keep=round(fine / fs))
    push = force[::round(fine / fs), :, None] * plant.shaker
    data = tuple(ModalData(f"exact {r + 1}", 1 / fs, analyst.MODES, motion.u[:, r], motion.v[:, r], motion.inertia[:, r], push[:, r], SLIP,
                           motion.q[:, r], motion.v[:, r] @ plant.joints.T, slice(0, len(push)), (20.0, 700.0), np.zeros(10))
                 for r in range(2))
    part = "Check of the algebra: recovery from exact motion of ten modes (inverse crime on purpose)"
    begin = np.concatenate([models.start[:2] * [1.001, 1.1], np.tile([1.2 * beam.F_S, -0.4, 0.2], len(SLIP))])
    for name in ("S2", "S3"):
        asked = analyst.problem(models.ten, data, name, places=0)
        found = nl.fit(asked, starts=1, seed=1, warm=begin, weights=asked.weight, iterations=400)
        values = analyst.values_of(found.theta)
        outer = np.abs(values[[0, 4]] / plants.true_joints(2) - 1).max()
        inner = max(np.abs(values[[1, 3], 2] / beam.CHI - 1).max(),
                    np.abs(analyst.softening(values)[[1, 3]] / analyst.softening(plants.true_joints())[0] - 1).max())
        book.add(part, name, "", f"outer joints (f_s, χ, β) within {outer:.1e}; inner joints, which only micro-slip, χ and softening "
                 f"within {inner:.1e}", f"mean square {found.mse:.1e}")
        book.numbers |= {f"algebra {name} outer": float(outer), f"algebra {name} inner": float(inner)}


def fits(book: Book, models: Models, recorded: Recorded, law: nl.Fit) -> dict[str, Fitted]:
    """Tables 3 and 4: S1, S2, S3 as the paper has them, and with the joints' own flexibility."""
    seed, starts = book.settings.seed, book.settings.pick(12, 6)
    out = {}
    for name, rounds in (("S1", 0), ("S2", 0), ("S3", 0), ("S2", 3), ("S3", 3)):
        found = analyst.fit_scenario(models.ten, recorded.data, recorded.windows, name, starts=starts, seed=seed, rounds=rounds,
                                     first=law.theta if rounds else None)
        out[found.name] = found
    part = "Table 3: mean square of the residual (Eq. 13a)"
    paper = {"S1": "0.37", "S2": "0.007", "S3": "0.006"}
    for name, found in out.items():
        book.add(part, name, paper.get(name, ""), f"{float(found.fit.problem.mse(found.fit.theta)):.3g}",
                 f"sensor noise alone {found.fit.problem.floor:.2g}")
    return out


PAPER_4 = {"S1": [(1696.3, -0.492, 0.138), (1005.5, -0.180, 0.247), (34.7, -0.01, 0.01), (904.1, -0.121, 0.233), (1781.5, -0.555, 0.222)],
           "S2": [(1945.4, -0.454, 4.0e-9), (2383.3, -0.562, 0.447), (34.7, -4.2e-10, 1), (1205.0, -0.656, 2.6e-6),
                  (2191.0, -0.493, 0.173)],
           "S3": [(1981.1, -0.493, 1.5e-8), (2087.9, -0.456, 0.111), (0, -0.9998, 0), (2040.2, -0.372, 0.091), (1924.6, -0.522, 0)]}
MAIN = {"S1": "S1", "S2": "S2 with joint flexibility", "S3": "S3 with joint flexibility"}
"""Which fit stands for each scenario in what follows."""


def posteriors(book: Book, found: dict[str, Fitted]) -> dict[str, nl.Posterior]:
    """Table 4 with bands: every parameter's 90 % interval."""
    out = {}
    for name, key in MAIN.items():
        fit = found[key].fit
        likelihood = WhittleLikelihood(fit, iterations=1 if name == "S1" else 0)
        out[name] = nl.sample(fit, likelihood=likelihood, ensembles=2, most=book.settings.pick(3000, 600),
                              block=book.settings.pick(200, 100), seed=book.settings.seed, workers=2)
    part = "Table 4: 4-parameter Iwan elements (f_s, χ, β); truth 2000, −0.5, 0.1; k_t known"
    for name, posterior in out.items():
        point = found[MAIN[name]].values
        low, _, high = posterior.quantiles((0.05, 0.5, 0.95))
        told = {row["name"]: row for row in posterior.summary()}
        for j, joint in enumerate(SLIP):
            k = 2 + 3 * j
            cells = [span(low[k + i], high[k + i], "{:.3g}" if i else "{:.5g}") for i in range(3)]
            vague = [p for p in ("f_s", "chi", "beta") if not told[f"iwan4[{joint}].{p}"]["identifiable"]]
            book.add(part, f"{name}, joint {j + 1}", ", ".join(f"{x:g}" for x in PAPER_4[name][j]),
                     f"{point[j, 0]:.5g}, {point[j, 2]:.3g}, {point[j, 3]:.2g}",
                     ", ".join(cells) + (f" ({', '.join(vague)} not identifiable)" if vague else ""))
        moving = [2 + 3 * j + i for j in (0, 1, 3, 4) for i in range(3)]
        truths = TRUE_THETA[[k - 2 for k in moving]]
        held = int(np.sum((low[moving] <= truths) & (truths <= high[moving])))
        book.add(part, f"{name}, joints that move", "", "", f"{held} of 12 intervals hold the truth")
        book.numbers[f"{name} intervals that hold the truth"] = held
        book.add(part, f"{name}, sampler", "", posterior.status, f"R-hat {posterior.convergence.rhat_max:.3f}, least effective samples "
                 f"{posterior.convergence.ess_min:.0f}")
    for name in ("S2", "S3"):
        low, mid, high = out[name].quantiles((0.05, 0.5, 0.95))
        book.numbers |= {f"{name} joint 1 f_s": float(mid[2]), f"{name} joint 5 f_s": float(mid[14]),
                         f"{name} joint 3 decades": float(np.log10(high[8] / low[8])),
                         f"{name} joint 1 decades": float(np.log10(high[2] / low[2]))}
    figures.posterior(book.figure("table04_posterior"), out)
    return out


def force_maps(book: Book, models: Models, recorded: Recorded, found: dict[str, Fitted],
               posteriors_: dict[str, nl.Posterior]) -> None:
    """Fig. 7: nonlinear force of mode 1 against its displacement, truth and bands."""
    B = models.ten.rows(SLIP)
    window = slice(*(round(t / recorded.data.dt) for t in recorded.windows["near resonance"]))
    force = recorded.tests.g[window, 0] @ B[:, 0]
    maps, miss = {}, {}
    for name, posterior in posteriors_.items():
        data = found[MAIN[name]].data[1]
        q = data.u[window][:, :1] @ B[:, :1].T if name == "S1" else data.q[window]
        draws = posterior.draws(60, book.settings.seed)
        values = np.array([analyst.excess(q, analyst.values_of(theta))[0] @ B[:, 0] for theta in draws])
        stiffness = (2 * np.pi) ** 2 * (draws[:, 0] ** 2 - models.ten.frequency[0] ** 2)
        values = values + stiffness[:, None] * data.u[window][:, 0]       # a shift of the linear frequency is part of the force found
        maps[name] = (data.u[window][:, 0], np.quantile(values, (0.05, 0.5, 0.95), axis=0))
        miss[name] = float(np.sqrt(np.mean((maps[name][1][1] - force) ** 2) / np.mean(force**2)))
    part = "Fig. 7: nonlinear force of mode 1 near resonance, rms error of the median, %"
    for name, value in miss.items():
        book.add(part, name, {"S1": "wrong", "S2": "right", "S3": "right"}[name], f"{100 * value:.2f}")
        book.numbers[f"map {name}"] = value
    figures.maps(book.figure("fig07_maps"), recorded.tests, window, maps, force)
