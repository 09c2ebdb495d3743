"""Force on lines that the excitation leaves out: real, or made by a bent force cell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bayes_nlsid.mismatch.calibrate import calibrate
from bayes_nlsid.mismatch.case import read_case
from bayes_nlsid.mismatch.cell import heard, straightened, without
from bayes_nlsid.mismatch.evidence import gather
from bayes_nlsid.mismatch.linear import fields, solve
from bayes_nlsid.mismatch.reduced import family
from bayes_nlsid.mismatch.spectra import steady_spectra
from tests.mismatch.test_mathematics import chain_family, steady
from tests.mismatch.truth import write_case

BAND = (3.0, 160.0)


@pytest.fixture(scope="module")
def driven():
    """A linear chain with force on even lines, and the response to it."""
    fam = chain_family(sensors=4)
    spectra = steady(fam, np.zeros(fam.size), noise=1e-5)
    rng = np.random.default_rng(5)
    stray = np.where(~spectra.excited & (spectra.frequency < 160), 0.02 * spectra.levels[:, None] ** 2, 0) * np.exp(
        2j * np.pi * rng.random(spectra.force.shape))
    answer = fields(fam, solve(fam, np.zeros(fam.size)), spectra.s).H[None] * stray[:, :, None]
    evidence = gather(spectra, BAND)
    fit = calibrate(fam, spectra.s[spectra.excited], evidence.H, evidence.variance)
    return fam, replace(spectra, stray=stray), answer, fit


def test_a_shaker_that_distorts_is_a_real_force_and_no_sign_of_the_structure(driven) -> None:
    fam, spectra, answer, fit = driven
    moved = replace(spectra, response=spectra.response + answer)
    assert gather(moved, BAND).even > 100          # taken for the structure's own it would be a strong distortion
    found = heard(moved, fam, fit, BAND)
    assert found is not None and found.real and found.share == pytest.approx(1.0, abs=5 / np.sqrt(found.information)) and found.gain < 0
    assert gather(without(moved, found), BAND).even == pytest.approx(1.0, abs=0.2)


def test_a_force_that_only_the_cell_reads_is_not_answered(driven) -> None:
    fam, spectra, _, fit = driven
    found = heard(spectra, fam, fit, BAND)
    assert found is not None and not found.real and abs(found.share) < 5 / np.sqrt(found.information)
    assert found.gain > 1000 and 0.001 < found.size < 0.1


def test_no_force_between_the_lines_is_nothing_to_judge(driven) -> None:
    fam, spectra, _, fit = driven
    assert heard(replace(spectra, stray=0 * spectra.stray), fam, fit, BAND) is None


def test_the_curve_of_a_bent_cell_is_straightened(tmp_path: Path) -> None:
    folder = tmp_path / "case"
    write_case(folder)
    true = {r.name: r.force for r in read_case(folder).records}
    rms = max(float(f.std()) for f in true.values())
    for file in folder.glob("*.npz"):
        with np.load(file) as raw:
            arrays = dict(raw)
        if "force" in arrays and np.abs(arrays["force"]).max() > 0:
            x = arrays["force"] / rms
            np.savez(file, **(arrays | {"force": arrays["force"] + 0.05 * rms * (x * x - 1) / (1 + 0.1 * x * x)}))
    case = read_case(folder)
    spectra = steady_spectra(case, case.select("steady"))
    evidence, fam = gather(spectra, case.band), family(case)
    fit = calibrate(fam, spectra.s[evidence.excited], evidence.H, evidence.variance)
    found = heard(spectra, fam, fit, case.band)
    assert found is not None and not found.real and found.gain > 1000
    straight = straightened(case, spectra)
    assert straight is not None
    loudest = max(straight.records, key=lambda r: float(r.force.std()))
    # a curve is known from what it makes between the lines but for a factor, which is the gain of the cell
    factor = float(true[loudest.name] @ loudest.force / (loudest.force @ loudest.force))
    assert factor == pytest.approx(1.0, abs=0.01)
    for bent, record in zip(case.records, straight.records, strict=True):
        force = true[record.name]
        if np.abs(force).max() > 0:
            left, before = (np.std(f - force) / np.std(force) for f in (factor * record.force, bent.force))
            assert left < max(0.1 * before, 0.003), record.name
