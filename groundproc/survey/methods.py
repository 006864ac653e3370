"""Methods that a trajectory can be made with: the name on the command line and the module, which is imported when it is used.

The list stands here because the survey's options are made of it and the survey knows no other room. What each method looks at, it says
itself (`estimation.method.Method`).
"""

from typing import Final

METHODS: Final = {
    "adjusted": "groundproc.estimation.adjustment.adjusted",
    "filtered": "groundproc.estimation.filtered",
    "dynamic": "groundproc.estimation.dynamic.dynamic",
    "ins": "groundproc.estimation.direct",
}
