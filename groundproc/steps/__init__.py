"""The flight from logs to products, step by step.

Each step is a file that says what it reads, which settings it looks at, and what it does (`step.Step`). What was made of what stands in the
ledger of the output folder (`ledger.Ledger`), so that a second run does only what changed, and an interrupted one goes on. All steps are
imported for every flight: what few flights need, such as the room of images, is imported where it is used.

log --clocks--> one time scale --trajectory--> estimate --place--> points and products --quality--> quality.json
photographs, estimate, points --images--> poses of images --colour, ortho, ndvi--> coloured cloud, mosaics
cloud.laz, estimate --uses--> ground, trees, wires, ...
estimate, quality.json, uses --products--> pictures and tables
"""

from typing import Final

ORDER: Final = ("clocks", "trajectory", "place", "images", "colour", "ortho", "ndvi", "quality", "uses", "products")
"""The steps, each a module of this package with a `STEP`."""
OF_IMAGES: Final = ("images", "colour", "ortho", "ndvi")
"""Those that have something to do only where there are photographs."""
