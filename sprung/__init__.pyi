# Read by type checkers, and at run time for what to load when a name is first used.
from .api import IdentifiedWindow as IdentifiedWindow
from .api import ParameterValue as ParameterValue
from .api import Tracked as Tracked
from .api import diagnose as diagnose
from .api import identify as identify
from .api import load_record as load_record
from .api import load_system as load_system
from .api import open_recording as open_recording
from .api import parse_system as parse_system
from .api import simulate as simulate
from .api import track as track
from .api import write_report as write_report
from .client import Client as Client

__version__: str
__all__: list[str]
