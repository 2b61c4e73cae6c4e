from uavctl.api.control import Runs as Runs
from uavctl.api.control import SolvedPlan as SolvedPlan
from uavctl.api.control import SteppedController as SteppedController
from uavctl.api.control import controller as controller
from uavctl.api.control import link as link
from uavctl.api.control import load as load
from uavctl.api.control import plant as plant
from uavctl.api.control import simulate as simulate
from uavctl.api.control import solve as solve
from uavctl.api.figures import plot as plot
from uavctl.api.flights import Flight as Flight
from uavctl.api.flights import Recording as Recording
from uavctl.api.flights import fly as fly
from uavctl.api.flights import read as read
from uavctl.config import Config as Config
from uavctl.config import presets as presets

__version__: str
__all__: tuple[str, ...]
