"""Probabilistic identification of nonlinear structural dynamics.

The public names below stand in the order of the method: recordings, linear structure, force laws, model, simulation, identification,
posterior, prediction, and whole studies. Each is imported from its room when it is first used, so that ``import bayes_nlsid`` is quick.
"""

from __future__ import annotations

from typing import Any

__version__ = "0.1.0"

# reading order: name -> module that holds it
_PUBLIC = {
    "InputError": "errors",
    # recordings
    "ChannelSpec": "recordings.reading", "RecordingSpec": "recordings.reading", "read_recording": "recordings.reading",
    "Recording": "recordings.recording", "Channel": "recordings.recording", "check": "recordings.checks",
    "kinematics": "recordings.kinematics", "noise_psd": "recordings.noise", "measured_backbone": "recordings.decay",
    "Backbone": "recordings.decay",
    # linear structure
    "LappedBeam": "structure.beam", "lapped_beam": "structure.beam", "oscillator": "structure.chains", "Structure": "structure.structure",
    "SolidBeam": "structure.solid_beam", "solid_beam": "structure.solid_beam",
    "read_matrices": "structure.matrices", "guyan": "structure.reduction", "iirs": "structure.reduction",
    "serep": "structure.bases", "craig_bampton": "structure.bases", "attachment_modes": "structure.bases",
    "identify_modes": "structure.identify", "polarity": "structure.polarity", "update": "structure.updating",
    "modal_model": "structure.modal_model", "ModalModel": "structure.modal", "modal_data": "structure.sensing",
           "ModalData": "structure.modal",
    # force laws and models
    "Term": "forces.term", "Param": "forces.parameter", "LIBRARY": "forces.library", "user_term": "forces.expression",
    "Element": "model", "Model": "model",
    # simulation
    "simulate": "simulation.integration", "Response": "simulation.response",
    # identification
    "Scenario": "identification.scenario", "scenario": "identification.scenario", "Problem": "identification.problem",
    "fit": "identification.fit", "Fit": "identification.fit", "select": "identification.select", "Selection": "identification.select",
    "output_error": "identification.output_error",
    # posterior
    "WhittleLikelihood": "inference.likelihood", "sample": "inference.ensemble", "Posterior": "inference.posterior",
    # prediction
    "backbone_bands": "prediction.bands", "Bands": "prediction.bands", "heldout": "prediction.heldout", "Heldout": "prediction.heldout",
    "response_curves": "prediction.continuation", "Curve": "prediction.continuation", "response_bands": "prediction.response_bands",
    "ResponseBands": "prediction.response_bands",
    "scattered_plan": "prediction.sampling_plan", "posterior_plan": "prediction.sampling_plan", "Plan": "prediction.sampling_plan",
    "plan_test": "prediction.planning", "MeasurementPlan": "prediction.planning",
    "Decay": "prediction.montecarlo", "backbones": "prediction.montecarlo", "sobol": "prediction.sensitivity",
    "dependent_shares": "prediction.sensitivity",
    # whole studies
    "read_study": "study.reading", "run_study": "study.run", "Study": "study.schema",
}

__all__ = ["__version__", *_PUBLIC]  # noqa: PLE0604 - the names are those of the table above


def __getattr__(name: str) -> Any:
    """A public name, imported from its room on first use."""
    from importlib import import_module

    if name not in _PUBLIC:
        raise AttributeError(f"module 'bayes_nlsid' has no attribute {name!r}")
    value = getattr(import_module(f"bayes_nlsid.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
