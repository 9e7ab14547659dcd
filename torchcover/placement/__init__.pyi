from .constraints import Constraints as Constraints
from .free_sensor import FreeSensor as FreeSensor
from .objective import Objective as Objective
from .space import SearchSpace as SearchSpace
from .variables import Choice as Choice
from .variables import Number as Number
from .variables import Variable as Variable
