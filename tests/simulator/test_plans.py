"""Named flights are whole, say what they are for, and yield to the command line."""

import argparse
from dataclasses import replace

import pytest

from flightlog.errors import ConfigError, UsageError
from simulator import command, plans
from simulator.autopilot import achieved_hz
from simulator.config import Options
from simulator.scene import scene


def asked(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command._plan(parser.parse_args([str(word) for word in words]))


@pytest.mark.parametrize("name", plans.names())
def test_every_flight_has_its_scene_and_route(name):
    plan = plans.plan(name)
    assert plan.about
    assert scene(plan.scene, 1, plan.options.flight.route).route.points_m


def test_the_surveys_are_what_methods_are_judged_by():
    fast, slow = plans.plan("survey_fast_gyro"), plans.plan("survey_slow_gyro")
    for plan in (fast, slow):
        options = plan.options
        rates = [achieved_hz(v, options.link.firmware) for v in (options.link.extra1_hz, options.link.position_hz)]
        assert rates == pytest.approx([10.0, 3.0], abs=0.1)
        assert options.ins.gnss_tau_s == 60
        assert 2.0 <= options.ins.gnss_sigma_m <= 3.0
        assert options.ins.gyro_delay_s == 0.008
        assert options.ins.gyro_scale == 0.01
        assert options.mount.boresight_spread_deg == 1.0
    assert achieved_hz(fast.options.link.raw_sensors_hz, fast.options.link.firmware) == 100.0
    assert achieved_hz(slow.options.link.raw_sensors_hz, slow.options.link.firmware) == 25.0
    # all else is the same
    assert replace(fast.options, link=slow.options.link) == slow.options


def test_what_is_said_beside_a_flight_goes_before_it(tmp_path):
    path = tmp_path / "options.yaml"
    path.write_text("ins: {gyro_scale: 0.02}\nclocks: {start_utc: 2026-05-21T00:00:00Z}\n")
    plan = asked("--flight", "survey_fast_gyro", "--duration", 5, "--config", path, "--returns", "dual")
    survey = plans.plan("survey_fast_gyro")
    assert (plan.scene, plan.duration_s) == (survey.scene, 5.0)
    assert plan.options.lidar.returns == "dual"
    assert plan.options.ins == replace(survey.options.ins, gyro_scale=0.02)
    assert plan.options.clocks.start_utc == "2026-05-21T00:00:00Z"
    assert plan.options.link == survey.options.link


def test_without_a_flight_all_is_as_ever():
    plan = asked()
    assert (plan.scene, plan.duration_s, plan.options) == ("village", 20.0, Options())


def test_a_flight_of_ones_own_is_a_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("scene: field\nduration_s: 3\noptions: {lidar: {rpm: 900}}\n")
    plan = asked("--flight", path)
    assert (plan.scene, plan.duration_s, plan.options.lidar.rpm) == ("field", 3.0, 900.0)
    path.write_text("scene: field\noption: {}\n")
    with pytest.raises(ConfigError, match=r"mine.yaml: unknown key 'option'"):
        asked("--flight", path)


def test_an_unknown_flight_or_route_is_refused_with_the_known_ones():
    with pytest.raises(UsageError, match=r"'moon' is neither a flight nor a file; known are .*survey_fast_gyro"):
        asked("--flight", "moon")
    with pytest.raises(UsageError, match="route 'moon' is not known in scene field; known are lines"):
        scene("field", 1, "moon")


def test_the_flights_are_listed(capsys):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    assert command.run(parser.parse_args(["--flights"])) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in plans.names())


@pytest.mark.parametrize(
    "name",
    ["meadow", "hover_lines", "crops", "slope", "barefield", "facades", "bank", "quarry", "emptystreet", "yardstreet"],
)
def test_natural_scenes_are_flown_with_the_instruments_of_the_survey(name):
    """But for what the air does to them: the line of the spin is that of a frame that gives way more than a tripod."""
    plan, survey = plans.plan(name), plans.plan("survey_fast_gyro")
    gyros = replace(plan.options.gyros, rotor_line_deg_s=survey.options.gyros.rotor_line_deg_s)
    assert replace(plan.options, flight=survey.options.flight, gyros=gyros) == survey.options
    if name not in ("facades", "emptystreet", "yardstreet"):
        assert min(plan.options.gyros.rotor_line_deg_s) > 0.0
        assert min(plan.options.flight.buzz_deg_s) > 0.0


def test_the_drive_of_three_minutes_covers_600_m():
    plan = plans.plan("drive_slowly")
    assert plan.options.flight.speed_m_s * (plan.duration_s - 3.0) == pytest.approx(600.0, rel=0.01)
