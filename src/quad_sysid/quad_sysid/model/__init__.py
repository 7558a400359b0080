"""The model of one axis: data, physics, noise, the compiled recursion, and the stored result."""

from quad_sysid.model.identified import (
    BEFORE,
    LAW,
    AxisModel,
    Designer,
    EffectEstimate,
    GainProposal,
    NoiseEstimate,
    Outside,
    Parameter,
    RungModel,
)

__all__ = ['BEFORE', 'LAW', 'AxisModel', 'Designer', 'EffectEstimate', 'GainProposal',
           'NoiseEstimate', 'Outside', 'Parameter', 'RungModel']
