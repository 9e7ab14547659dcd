from .bits import Bits as Bits
from .common_instants import CommonInstants as CommonInstants
from .objective import Objective as Objective
from .scores import Scores as Scores
