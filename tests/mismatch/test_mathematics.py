"""The algebra the mismatch engine stands on, against independent references."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from bayes_nlsid.forces.library import LIBRARY
from bayes_nlsid.forces.motion import force_along, motion
from bayes_nlsid.forces.term import Term
from bayes_nlsid.mismatch.calibrate import assemble, calibrate, descend, finish, floored
from bayes_nlsid.mismatch.catalogue import CATALOGUE, ROWS, catalogue_rows
from bayes_nlsid.mismatch.effects import Effect, along_period, pack, unpack
from bayes_nlsid.mismatch.evidence import gather
from bayes_nlsid.mismatch.form import PSEUDO
from bayes_nlsid.mismatch.krylov import gmres
from bayes_nlsid.mismatch.laws import Size
from bayes_nlsid.mismatch.linear import Attachment, Family, fields, jacobian, receptances, shape_sizes, solve
from bayes_nlsid.mismatch.motion import settle
from bayes_nlsid.mismatch.paths import LawAlong, bed
from bayes_nlsid.mismatch.poles import pair, vector_fit
from bayes_nlsid.mismatch.probability import BY_HAND, Score, Scores, features, fit_layer, probabilities, reserved, task_of
from bayes_nlsid.mismatch.prove import calibrate_bands, elpd_difference, nrmse
from bayes_nlsid.mismatch.shapes import shape_columns
from bayes_nlsid.mismatch.spectra import Spectra


def chain_family(n: int = 8, sensors: int = 4) -> Family:
    """A chain of masses and springs with its end springs, one inner spring and all masses as parts."""
    K_parts, names = [], []
    for i in (0, 3, 5):
        b = np.zeros(n)
        b[i] = 1
        if i:
            b[i - 1] = -1
        K_parts.append(4e5 * np.outer(b, b))
        names.append(f"J{i}_slip")
    rest = np.zeros((n, n))
    for i in (1, 2, 4, 6, 7):
        b = np.zeros(n)
        b[i], b[i - 1] = 1, -1
        rest += 4e5 * np.outer(b, b)
    M_parts = np.array([np.diag(np.linspace(1.0, 1.3, n))])
    eye = np.eye(n)
    places = {"J3_slip": eye[3] - eye[2], "J5_slip": eye[5] - eye[4]}
    rows = eye[[1, 3, 5, 7]] if sensors == 4 else eye[np.arange(sensors) % n]
    values, basis = eigh(sum(K_parts) + rest, M_parts[0])
    single = {i: _direction(k) for i, k in enumerate(K_parts)}
    return Family((*names, "M:rho"), np.array(K_parts), M_parts, rest, np.zeros((n, n)), rows, eye[2], -np.ones(n),
                  np.ones(sensors), places, {"P1": eye[1], "P4": eye[7]}, np.array([0.3, 0.3, 0.3, 0.01]), 6, 0.01,
                  single, np.zeros((0, n)), M_parts[0] @ basis[:, :7] * np.sqrt(values[:7]),
                  np.array([places["J3_slip"], places["J5_slip"]]),
                  np.array([3.0, 3.0]))


def _direction(part: np.ndarray) -> np.ndarray:
    j = int(np.argmax(np.diag(part)))
    return part[j] / np.sqrt(part[j, j])


def steady(fam: Family, theta: np.ndarray, laws: tuple = (), places: tuple[str, ...] = (), noise: float = 1e-4, records: int = 4,
           seed: int = 0) -> Spectra:
    """Records of a member of the family with laws at places, computed by brute-force relaxation on a fine grid."""
    rng = np.random.default_rng(seed)
    block, rate = 1024, 512.0
    lines = np.arange(4, 440)
    excited = (lines % 2 == 1) & (lines < 330)
    modes = solve(fam, theta)
    levels = np.array([0.3, 1.0, 1.0, 0.3])[:records]
    half = np.zeros((records, block // 2 + 1), dtype=complex)
    half[:, lines[excited]] = levels[:, None] * np.exp(2j * np.pi * rng.random((records, excited.sum())))
    waves = np.fft.irfft(half * block, block, axis=1)
    s = 2j * np.pi * lines * rate / block
    Y = half[:, lines, None] * fields(fam, modes, s).H
    empty = Spectra(tuple("abcd"[:records]), "steady", block, rate, 0.0, lines, excited, half[:, lines], Y, np.full(Y.shape, noise ** 2),
                    np.full(half[:, lines].shape, 1e-20), waves, np.zeros((0, len(lines), Y.shape[2]), dtype=complex), levels,
                    np.arange(records) * 10.0)
    if laws:
        rows = np.array([fam.places[p] for p in places])
        paths = bed(modes, empty, rows, fam.shaker)
        h = s[:, None, None] ** 2 * receptances(modes, s, fam.sensors, rows)
        for r in range(records):
            _, G, status = settle(paths, r, laws)
            assert status == "ok"
            Y[r] -= np.einsum("lsj,lj->ls", h, G[lines])
    Y = Y + noise / np.sqrt(2) * (rng.normal(size=Y.shape) + 1j * rng.normal(size=Y.shape))
    return Spectra(empty.names, "steady", block, rate, 0.0, lines, excited, half[:, lines], Y, np.full(Y.shape, noise ** 2),
                   empty.force_noise, waves, empty.scatter, levels, empty.starts)


def cubic(k: float) -> LawAlong:
    return LawAlong(lambda d, v, dt: k * d ** 3, lambda d, v: (3 * k * d ** 2, 0 * v))


def test_projection_removes_any_linear_change_exactly() -> None:
    fam = chain_family()
    spectra = steady(fam, np.zeros(fam.size))
    evidence = gather(spectra, (1.0, 170.0))
    rng = np.random.default_rng(1)
    change = rng.normal(size=len(spectra.lines)) + 1j * rng.normal(size=len(spectra.lines))
    assert np.abs(evidence.project(change * spectra.force)).max() < 1e-12 * np.abs(change).max() * np.abs(spectra.force).max()
    other = rng.normal(size=spectra.force.shape) + 1j * rng.normal(size=spectra.force.shape)
    once = evidence.project(other)
    assert np.allclose(evidence.project(once), once, rtol=0, atol=1e-12)
    assert evidence.statistic == pytest.approx(1.0, abs=0.1)


def test_receptance_with_attachments_equals_direct_inversion() -> None:
    fam = chain_family()
    rng = np.random.default_rng(2)
    theta = 0.3 * rng.normal(size=fam.size) * fam.prior_sd
    theta[len(fam.names):] = 0
    s = 2j * np.pi * np.linspace(3, 150, 7)
    modes = solve(fam, theta)
    attach = (Attachment(fam.points["P1"], 0.3 * s ** 2), Attachment(fam.places["J5_slip"], 5e4 + 0 * s))
    got = fields(fam, modes, s, attach).H
    scale = np.exp(theta[:4])
    K = np.tensordot(scale[:3], fam.K_parts, 1) + fam.K_rest
    M = scale[3] * fam.M_parts[0]
    C = M @ modes.basis @ np.diag(2 * modes.zeta * modes.omega) @ modes.basis.T @ M
    for k, sk in enumerate(s):
        Z = M * sk ** 2 + C * sk + K + sum(a.z[k] * np.outer(a.direction, a.direction) for a in attach)
        assert np.allclose(got[k], sk ** 2 * fam.sensors @ np.linalg.solve(Z, fam.shaker), rtol=1e-9)


def test_jacobian_against_differences() -> None:
    fam = chain_family()
    rng = np.random.default_rng(3)
    theta = 0.5 * rng.normal(size=fam.size) * fam.prior_sd
    theta[fam.moving + fam.modes:][:len(fam.dashpots)] = 0    # they couple the modes to first order only
    s = 2j * np.pi * np.linspace(3, 150, 40)
    J = jacobian(fam, theta, fields(fam, solve(fam, theta), s), s)
    for i in range(fam.size):
        d = 1e-5 * (np.arange(fam.size) == i)
        difference = (fields(fam, solve(fam, theta + d), s).H - fields(fam, solve(fam, theta - d), s).H) / 2e-5
        assert np.linalg.norm(J[i] - difference) < 2e-3 * np.linalg.norm(difference), fam.names[i] if i < 4 else i


def test_errors_of_form_are_stiffness_between_nominal_modes_and_dashpots_couple_the_modes() -> None:
    fam = chain_family()
    theta = np.zeros(fam.size)
    theta[-len(fam.pairs[0]):] = 0.01 * np.random.default_rng(4).normal(size=len(fam.pairs[0]))
    theta[fam.moving:fam.moving + fam.modes] = 0.02
    s = 2j * np.pi * np.linspace(3, 150, 9)
    form = np.zeros((7, 7))
    form[fam.pairs] = theta[-len(fam.pairs[0]):]
    K = fam.K_parts.sum(0) + fam.K_rest + fam.mixing @ (form + form.T) @ fam.mixing.T
    M = fam.M_parts[0]
    modes = solve(fam, theta)
    modal = fam.shaker @ modes.basis
    modal[:fam.modes] += 0.02 * shape_sizes(fam, modes)
    force = M @ modes.basis @ modal
    damping = np.diag(2 * modes.zeta * modes.omega)
    for c in (0.0, 0.03, 0.003):
        theta[fam.moving + fam.modes] = c
        row = fam.dashpots[0] @ modes.basis
        coupled = damping + 3.0 * c * (np.outer(row, row) - np.diag(row ** 2))
        C = M @ modes.basis @ coupled @ modes.basis.T @ M
        exact = np.array([sk ** 2 * fam.sensors @ np.linalg.solve(M * sk ** 2 + C * sk + K, force) for sk in s])
        assert np.linalg.norm(fields(fam, solve(fam, theta), s).H - exact) < (1e-9 + 30 * c ** 2) * np.linalg.norm(exact)


def test_modes_keep_their_signs_so_that_errors_of_their_shapes_keep_their_meaning() -> None:
    fam = chain_family()
    rng = np.random.default_rng(8)
    nominal = solve(fam, np.zeros(fam.size)).basis[:, :fam.modes]
    for _ in range(20):
        moved = solve(fam, 2 * rng.normal(size=fam.size) * fam.prior_sd).basis[:, :fam.modes]
        assert (np.einsum("nm,nk,km->m", nominal, np.einsum("pij->ij", fam.M_parts) + fam.M_rest, moved) > 0).all()


def test_what_the_features_speak_against_keeps_a_reserve() -> None:
    one = Scores((Score((("hardening", "J1"),), 300.0), Score((("clearance", "J1"), ("sensor_gain", "S2")), 320.0)))
    keys, table = features(one)
    missed = reserved(keys, np.array([0.2, 0.6, 0.1, 0.1]))
    assert sum(missed.values()) == pytest.approx(1.0)
    assert (("hysteresis", "J1"),) in missed and (("sensor_gain", "-"),) in missed and (("force_gain", "FORCE"),) in missed
    assert (("hardening", "J1"), ("softening", "J1")) in missed and () not in missed and (("other", "-"),) not in missed
    assert missed[(("hardening", "J1"),)] == pytest.approx(1 / 6)     # a third for what was proposed
    assert sum(probabilities(one).values()) == pytest.approx(1.0)
    assert probabilities(one)[(("hysteresis", "J1"),)] > 0


def test_the_layer_is_fitted_with_the_right_gradient() -> None:
    one = Scores((Score((("hardening", "J1"),), 300.0), Score((("hardening", "J2"),), 290.0), Score((("clearance", "J1"),), 299.0)))
    w = np.array(BY_HAND.weights)
    for truth in ((("hardening", "J2"),), (("hysteresis", "J1"),), (), (("other", "J3"),)):
        task = task_of(one, truth)
        slope = task.loss(w, 0.03)[1]
        for i in range(len(w)):
            d = 1e-6 * (np.arange(len(w)) == i)
            assert slope[i] == pytest.approx((task.loss(w + d, 0.03)[0] - task.loss(w - d, 0.03)[0]) / 2e-6, abs=1e-6)


def test_calibration_follows_narrow_bent_valleys_to_one_optimum() -> None:
    fam = chain_family(sensors=3)
    rng = np.random.default_rng(21)
    truth = 0.7 * rng.normal(size=fam.size) * fam.prior_sd
    truth[fam.moving + fam.modes:][:len(fam.dashpots)] = 0
    s = 2j * np.pi * np.linspace(2, 150, 400)
    H = fields(fam, solve(fam, truth), s).H
    noise = 1e-5 * np.sqrt(np.mean(np.abs(H) ** 2))
    H = H + noise * (rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)) / np.sqrt(2)
    variance = np.full(H.shape, noise ** 2)
    best, _, cost = descend(fam, truth, s, H, variance, 40, tol=1e-6)
    normal = assemble(fam, best, np.zeros(0), s, H, variance).normal + np.diag(1 / fam.prior_sd ** 2)
    weak = np.linalg.eigh(fam.prior_sd[:, None] * normal * fam.prior_sd)[1][:, :3]
    for along in weak.T:
        start = best + 3 * fam.prior_sd * along
        rise = descend(fam, start, s, H, variance, 0)[2] - cost
        end, _, there = descend(fam, start, s, H, variance, 12, tol=1e-6)
        assert rise > 5 and abs(there - cost) < 1e-3 and np.abs(end - best).max() < 1e-3


def test_cost_is_the_marginal_likelihood_of_random_shape_errors() -> None:
    fam = chain_family(sensors=3)
    spectra = steady(fam, np.zeros(fam.size), noise=1e-5)
    evidence = gather(spectra, (1.0, 170.0))
    s, theta = spectra.s[spectra.excited][::4], np.zeros(fam.size)
    H, variance = evidence.H[::4], floored(evidence.H, evidence.variance)[::4]

    def brute(spread: np.ndarray) -> float:
        system = assemble(fam, theta, np.zeros(0), s, H, variance, spread=spread)
        total = PSEUDO * ((fam.error_sd / spread) ** 2 + 2 * np.log(spread)).sum()
        for B, r in zip(system.B, system.r, strict=True):
            covariance = np.eye(len(r)) + B.T @ (spread[:, None] ** 2 * B)
            total += r @ np.linalg.solve(covariance, r) + np.linalg.slogdet(covariance)[1]
        return float(total)

    spreads = [fam.error_sd, 2 * fam.error_sd, fam.error_sd * np.linspace(0.5, 3, len(fam.error_sd))]
    costs = [assemble(fam, theta, np.zeros(0), s, H, variance, spread=x).chi2 for x in spreads]
    for x, cost in zip(spreads[1:], costs[1:], strict=True):
        assert cost - costs[0] == pytest.approx(brute(x) - brute(spreads[0]), rel=1e-6)


def test_size_of_shape_errors_is_found_mode_by_mode() -> None:
    fam = chain_family(sensors=30)
    modes = solve(fam, np.zeros(fam.size))
    s = 2j * np.pi * np.linspace(3, 1.2 * modes.omega[5] / (2 * np.pi), 400)
    fld = fields(fam, modes, s)
    true = np.full(len(fam.error_sd), 0.001)
    true[2] = 0.03
    rng = np.random.default_rng(5)
    errors = true * rng.normal(size=(30, len(true)))
    H = fld.H + np.einsum("mls,sm->ls", shape_columns(fam, fld, s), errors)
    noise = 1e-5 * np.abs(H).max()
    H = H + noise * (rng.normal(size=H.shape) + 1j * rng.normal(size=H.shape)) / np.sqrt(2)
    fit = finish(fam, np.zeros(fam.size), s, H, np.full(H.shape, noise ** 2))
    assert fit.spread[2] == pytest.approx(0.03, rel=0.35)
    assert (fit.spread[[0, 1, 3, 4]] < 0.004).all()


def test_calibration_recovers_known_multipliers() -> None:
    fam = chain_family()
    theta = np.zeros(fam.size)
    theta[:4] = [0.5, -0.4, 0.35, 0.005]
    spectra = steady(fam, theta, noise=1e-6)
    evidence = gather(spectra, (1.0, 170.0))
    fit = calibrate(fam, spectra.s[spectra.excited], evidence.H, evidence.variance)
    assert fit.status == "ok"
    assert np.abs(fit.theta[:3] - theta[:3]).max() < 0.06
    assert fit.cost < 1.2 * fit.dof


def test_vector_fitting_finds_poles_and_shapes() -> None:
    fam = chain_family()
    modes = solve(fam, np.zeros(fam.size))
    s = 2j * np.pi * np.linspace(3, 150, 300)
    H = receptances(modes, s, fam.sensors, fam.shaker[None])[:, :, 0]
    true = modes.omega * (-modes.zeta + 1j * np.sqrt(1 - modes.zeta ** 2))
    inside = modes.omega < 2 * np.pi * 140
    poles, residues = vector_fit(s, H, np.full(H.shape, 1e-24), 1.07 * true[inside])
    for p in true[inside]:
        assert np.abs(poles - p).min() < 1e-3 * np.abs(p)
    pairs = pair(fam, poles, residues, modes.omega[inside], modes.basis[:, inside])
    assert sorted(i for i, _ in pairs) == list(range(int(inside.sum())))


def test_settled_motion_solves_the_equation_in_time() -> None:
    """Duffing oscillator: the spectrum found must satisfy M ẍ + C ẋ + K x + k x³ = F on every sample."""
    fam = chain_family()
    spectra = steady(fam, np.zeros(fam.size), records=2)
    modes = solve(fam, np.zeros(fam.size))
    row = fam.places["J3_slip"]
    paths = bed(modes, spectra, row[None], fam.shaker)
    scale = paths.in_time(paths.linear(1))[0].std()
    law = cubic(0.1 * 4e5 / scale ** 2)
    D, G, status = settle(paths, 1, (law,))
    assert status == "ok"
    assert np.linalg.norm(G * paths.among[:, 0]) > 0.02 * np.linalg.norm(D)
    q = (1 / modes.denominators(paths.s)) * ((fam.shaker @ modes.basis) * paths.drive[1][:, None] - (row @ modes.basis) * G)
    d = np.fft.irfft(q @ (row @ modes.basis) * paths.samples, paths.samples)
    g = np.fft.irfft(G[:, 0] * paths.samples, paths.samples)
    assert np.abs(d - paths.in_time(D)[0][:, 0]).max() < 1e-3 * np.abs(d).max()
    assert np.abs(g - law.force(d, d, 0.0)).max() < 5e-3 * np.abs(g).max()


def _as_law(term: Term, p: np.ndarray) -> LawAlong:
    def slope(d: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stiffness, damping = term.slope(d, v, *p)
        return np.broadcast_to(stiffness, d.shape), np.broadcast_to(damping, d.shape)

    return LawAlong(lambda d, v, dt: np.asarray(term.static_force(d, v, p)), slope)


@pytest.mark.parametrize("begun", [False, True])
def test_a_march_agrees_with_newton_on_the_whole_record(begun: bool) -> None:
    """Two places with strong laws; the march steps through the same periods that the fixed point is sought over."""
    codes = pytest.importorskip("bayes_nlsid.forces.compiled")
    fam = chain_family()
    spectra = steady(fam, np.zeros(fam.size), records=2)
    paths = bed(solve(fam, np.zeros(fam.size)), spectra, np.array([fam.places["J3_slip"], fam.places["J5_slip"]]), fam.shaker)
    d, v = (x.std(0) for x in paths.in_time(paths.linear(1)))
    values = [np.array([0.2 * 4e5 / d[0] ** 2]), np.array([0.1 * 4e5 * d[1] / v[1] ** 2])]
    terms = [LIBRARY["cubic"], LIBRARY["v|v|"]]
    laws = tuple(_as_law(t, p) for t, p in zip(terms, values, strict=True))
    marched = tuple(replace(law, code=codes.law_code(t), values=p) for law, t, p in zip(laws, terms, values, strict=True))
    start = 0.9 * paths.linear(1) if begun else None
    D, G, status = settle(paths, 1, marched, start)
    E, H, other = settle(paths, 1, laws)
    assert status == other == "ok"
    assert np.linalg.norm(E - paths.linear(1)) > 0.1 * np.linalg.norm(E)
    # what differs: force linear between steps there, aliases of |v| v at twice the rate of the recording here
    assert np.linalg.norm(D - E) < 6e-3 * np.linalg.norm(E) and np.linalg.norm(G - H) < 5e-2 * np.linalg.norm(H)


def test_a_march_feels_resonances_fully_with_few_steps() -> None:
    """A spring far from linear: between steps its force is taken as straight, of which each mode must not lose its own frequency."""
    codes = pytest.importorskip("bayes_nlsid.forces.compiled")
    fam = chain_family()
    spectra = steady(fam, np.zeros(fam.size), records=2)
    paths = bed(solve(fam, np.zeros(fam.size)), spectra, fam.places["J3_slip"][None], fam.shaker)
    d = paths.in_time(paths.linear(1))[0].std()
    p = np.array([0.1 * 4e5 / d ** 2])
    law = replace(_as_law(LIBRARY["cubic"], p), code=codes.law_code(LIBRARY["cubic"]), values=p)
    found = {m: settle(replace(paths, marched=m), 1, (law,))[0] for m in (1, 2, 32)}
    change = np.linalg.norm(found[32] - paths.linear(1))
    errors = [np.linalg.norm(found[m] - found[32]) / change for m in (1, 2)]
    assert change > 0.5 * np.linalg.norm(paths.linear(1))
    assert max(errors) < 0.003


def test_a_hard_stop_does_not_ring() -> None:
    """A gap a hundred times stiffer than the joint it sits in: with steps too long for it the march refines them by itself."""
    codes = pytest.importorskip("bayes_nlsid.forces.compiled")
    fam = chain_family()
    spectra = steady(fam, np.zeros(fam.size), records=2)
    paths = bed(solve(fam, np.zeros(fam.size)), spectra, fam.places["J3_slip"][None], fam.shaker)
    gap = ROWS["clearance"].laws[1]
    d = paths.in_time(paths.linear(1))[0].std()
    p = np.array([4e7, 2.0 * d, 0.02])
    assert gap.term.name == "rounded_gap"
    law = replace(_as_law(gap.term, p), code=codes.law_code(gap.term), values=p)
    found = [settle(replace(paths, marched=m), 1, (law,)) for m in (1, 4, 64)]
    assert all(status == "ok" for _, _, status in found)
    change = np.linalg.norm(found[2][0] - paths.linear(1))
    assert change > 0.5 * np.linalg.norm(paths.linear(1))
    for D, _, _ in found[:2]:
        assert np.linalg.norm(D - found[2][0]) < 0.02 * change


def test_gmres_solves_a_real_linear_system() -> None:
    rng = np.random.default_rng(5)
    A = np.eye(30) + 0.2 * rng.normal(size=(30, 30))
    b = rng.normal(size=30)
    x = gmres(lambda y: (A @ y.real).astype(complex), b.astype(complex), 30, 1e-12)
    assert np.allclose(A @ x.real, b, atol=1e-9)


@pytest.mark.parametrize("number", [0, 1])
def test_sliders_agree_with_the_library(number: int) -> None:
    law = ROWS["hysteresis"].laws[number]
    rng = np.random.default_rng(6)
    F = np.zeros(1025, dtype=complex)
    F[5:120] = rng.normal(size=115) + 1j * rng.normal(size=115)
    d = np.fft.irfft(F, 2048)
    d /= d.std()
    v = np.fft.irfft(2j * np.pi * np.arange(1025) * np.fft.rfft(d), 2048)
    values = law.shapes(Size(1.0, 1.0, 3.0))[3]
    first = int(np.argmax(np.abs(d)))
    path = motion(np.append(np.roll(d, -first), d[first]), np.append(np.roll(v, -first), v[first]), 1 / 2048)
    reference = np.roll(force_along(law.term, path, values, excess=True)[:-1], first)
    assert np.linalg.norm(along_period(law, values, d, v, 1 / 2048, True) - reference) < 0.02 * np.linalg.norm(reference)


def test_effects_pack_and_unpack() -> None:
    for row in CATALOGUE:
        for law in row.laws:
            values = law.shapes(Size(1e-5, 1e-2, 3e-5, 1e6))[1]
            effect = Effect(row.name, "J1_slip", law, values)
            assert np.allclose(unpack(effect, pack(effect), effect).values, values)
    assert all(row["class"] and row["separated by"] for row in catalogue_rows())


def test_probabilities_sum_to_one_and_rise_with_gain() -> None:
    def case(gain: float) -> dict:
        return probabilities(Scores((Score((("hardening", "TIP_w"),), gain), Score((("clearance", "TIP_w"),), 0.6 * gain))))

    none = []
    for gain in (1.0, 10.0, 50.0, 300.0, 1e5):
        found = case(gain)
        assert sum(found.values()) == pytest.approx(1.0, abs=1e-12)
        assert (("other", "-"),) in found and () in found
        none.append(found[()])
    assert all(a > b for a, b in zip(none[:-1], none[1:], strict=True))
    wide = probabilities(Scores((Score((("hardening", "A"),), 1000.0), Score((("clearance", "A"),), 100.0))))
    close = probabilities(Scores((Score((("hardening", "A"),), 1000.0), Score((("clearance", "A"),), 990.0))))
    assert wide[(("hardening", "A"),)] > close[(("hardening", "A"),)]


def test_layer_learns_where_nothing_ends() -> None:
    """Real effects gain about 2000, chance about 200: the fitted layer must put the border between them."""
    rng = np.random.default_rng(8)
    key = (("coulomb", "J1_slip"),)
    scores, truths = [], []
    for i in range(60):
        real = i % 2 == 0
        gain = float(np.exp(rng.normal(np.log(2000) if real else np.log(200), 0.4)))
        scores.append(Scores((Score(key, gain),)))
        truths.append(key if real else ())
    layer = fit_layer(scores, truths, spread=3.0)
    chance, real_one = (probabilities(Scores((Score(key, gain),)), layer)[()] for gain in (200.0, 2000.0))
    assert chance > 0.75 and real_one < 0.25


def test_layer_has_calibrated_odds_where_evidence_is_weak() -> None:
    """Two classes that swap in three of ten cases: the leading one must get seven tenths, not certainty."""
    rng = np.random.default_rng(3)
    a, b = (("softening", "J1_slip"),), (("hysteresis", "J1_slip"),)
    scores, truths = [], []
    for _ in range(300):
        scores.append(Scores((Score(a, 5000.0), Score(b, 4900.0)), dispersion=1.5))
        truths.append(a if rng.random() < 0.7 else b)
    found = probabilities(scores[0], fit_layer(scores, truths, spread=3.0))
    assert found[a] / (found[a] + found[b]) == pytest.approx(np.mean([t == a for t in truths]), abs=0.03)


def test_bands_cover_nine_tenths_and_elpd_knows_the_better_model() -> None:
    rng = np.random.default_rng(9)
    true = rng.normal(size=(8000, 2))
    measured = true + 0.1 * rng.normal(size=true.shape)
    bands = calibrate_bands(np.full(2, 0.1), [measured], [true], 100.0)
    assert np.mean(np.abs(measured - true) < bands.factor * bands.sd(true, 100.0)) == pytest.approx(0.9, abs=0.01)
    poor = 0.8 * true
    worse = calibrate_bands(np.full(2, 0.1), [measured], [poor], 100.0)
    gain, se = elpd_difference(measured, poor, true, worse, bands, 100.0)
    assert gain > 5 * se > 0
    assert nrmse(measured, true) < nrmse(measured, poor)


def test_distortion_without_any_hypothesis_is_something_else_not_nothing() -> None:
    assert probabilities(Scores(())) == {(): 1.0}
    lost = probabilities(Scores((), unexplained=1.0))
    assert lost[(("other", "-"),)] > 0.9 and sum(lost.values()) == pytest.approx(1.0)
