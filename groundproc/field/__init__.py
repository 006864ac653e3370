"""At the airfield: logs fetched from the aircraft, and played again."""
