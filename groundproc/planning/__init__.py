"""Before the flight: lines over an area, the density that they give, and a mission that the autopilot flies."""
