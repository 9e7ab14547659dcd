from . import cameras as cameras
from . import coverage as coverage
from . import data as data
from . import detection as detection
from . import evaluation as evaluation
from . import geometry as geometry
from . import metrics as metrics
from . import neighbors as neighbors
from . import report as report
from . import simulation as simulation
from . import targets as targets
from . import training as training
from .cameras import Camera as Camera
from .coverage import BevGrid as BevGrid
from .coverage import Coverage as Coverage
from .coverage import CoverageMetric as CoverageMetric
from .coverage import Region as Region
from .coverage import forward_regions as forward_regions
from .data import RegionsOfInterest as RegionsOfInterest
from .evaluation import compare as compare
from .evaluation import evaluate as evaluate
from .evaluation import survey_target as survey_target
from .neighbors import blind_spot_radius as blind_spot_radius
from .neighbors import nearest as nearest
from .simulation import Rig as Rig
from .simulation import Scenario as Scenario

__version__: str
