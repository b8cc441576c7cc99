"""Pictures of a stage: frames, passes, films, contact sheets, figures."""

from vehsim.runtime.lazy import attach

__getattr__, __dir__ = attach(__name__)
