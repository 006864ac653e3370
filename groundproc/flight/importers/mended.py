"""What was put right in the times of a recording, in words."""

from flightlog.clock import utc_text
from flightlog.constants import NS_PER_S
from groundproc.flight.importers.steady import Steady


def mended(steady: Steady) -> list[str]:
    """A sentence on each kind of mend; complete once the recording has been read."""
    said = []
    if steady.steps_back or steady.steps_ahead:
        count = {"back": steady.steps_back, "ahead": steady.steps_ahead}
        times = " and ".join(f"{way} {number} times" for way, number in count.items() if number)
        seconds = abs(steady.stepped_ns) / NS_PER_S
        said.append(f"its clock was set {times}, by {seconds:.3f} s in all; times carried on by the devices' clocks")
    if steady.wild_stamps:
        said.append(f"{steady.wild_stamps} stamps were wild, mended by the devices' clocks")
    if steady.out_of_order:
        said.append(f"{steady.out_of_order} packets or frames were out of order, put in their place")
    if steady.out_of_range:
        said.append(f"{steady.out_of_range} packets or frames lie before 1970 or after 2038 and are left out")
    # where the very first stamp was wild all others are right
    if steady.moved_ns and steady.first_ns is not None and (steady.steps_ahead or not steady.wild_stamps):
        stamped, used = utc_text(steady.first_ns - steady.moved_ns), utc_text(steady.first_ns)
        said.append(f"its computer had no clock, its stamps begin at {stamped}; taken to begin at {used}")
    return said
