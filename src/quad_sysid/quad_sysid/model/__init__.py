"""The model of one axis: data, physics, noise and the compiled recursion; and what is handed on."""

from quad_sysid.model.identified import (
    AxisModel,
    Designer,
    EffectEstimate,
    GainProposal,
    NoiseEstimate,
    Parameter,
)

__all__ = ['AxisModel', 'Designer', 'EffectEstimate', 'GainProposal', 'NoiseEstimate', 'Parameter']
