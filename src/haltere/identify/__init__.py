"""Identification of a vehicle from its flights: drag in wind, forces and moments. It navigates nothing; `haltere.drive` does."""

from haltere.identify.autopilots import ardupilot_parameters, px4_parameters
from haltere.identify.drag import DragIdentification, NotObservableError, identify_drag

__all__ = ["DragIdentification", "NotObservableError", "ardupilot_parameters", "identify_drag", "px4_parameters"]
