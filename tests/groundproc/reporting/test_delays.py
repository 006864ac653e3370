"""Delays of gyros in words."""

from groundproc.reporting.delays import delays


def found(value_s: float, sigma_s: float, *, held: bool) -> dict[str, list[float] | list[bool]]:
    return {"value": [value_s], "sigma": [sigma_s], "prior_sigma": [0.005], "held": [held]}


def test_what_the_flight_tells_is_said_with_its_sigma_and_what_is_held_is_not() -> None:
    estimated = {
        "lidar.delay_s": found(0.00512, 0.00013, held=False),
        "ins.delay_s": found(-0.0003, 0.00021, held=False),
    }
    quality = {"trajectory": {"method": "adjusted"}, "adjusted": {"estimated": estimated}}
    assert delays(quality) == (
        "delay of gyros: the lidar's against its returns +5.12 ms, sigma 0.13 ms; "
        "the autopilot's beyond the synchronisation -0.30 ms, sigma 0.21 ms"
    )
    del estimated["ins.delay_s"]
    estimated["lidar.delay_s"] = found(0.001, 0.0045, held=True)
    assert delays(quality) == ""
    assert delays({"trajectory": {"method": "ins"}}) == ""
