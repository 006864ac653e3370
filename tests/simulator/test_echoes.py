"""Echoes of a beam against hand-made surfaces."""

import numpy as np
import pytest

from simulator.echoes import LAST, MIXED, RANGE, RAYS, RING, SECOND, STRENGTH, STRONGEST, TRIANGLE, aim, form

DIFFUSE, HALF, GLASS = 0, 1, 2
TABLES = np.array([[1.0, 0.5, 0.1], [1.0, 1.0, 1.0], [0.0, 0.0, 0.9]])
EVERYTHING = 1e-9


def echoes_of(hits, planes, material, clear=None, threshold=EVERYTHING):
    """Echoes of one shot along +x whose rays meet the planes given by number."""
    rays = len(hits)
    origins = np.zeros((rays, 3), np.float32)
    directions = np.tile(np.float32([1, 0, 0]), (rays, 1))
    return form(
        origins,
        directions,
        np.array(hits, np.int32),
        np.full(rays, -1, np.int32) if clear is None else np.array(clear, np.int32),
        np.array([[1.0, 0.0, 0.0, d] for d in planes]),
        np.array(material, np.uint8),
        TABLES,
        rays,
        np.ones((1, 2)),
        threshold,
        100.0,
        np.zeros((0, 4)),
        np.zeros(0, np.uint8),
    )[0]


def test_one_surface_gives_one_echo_that_is_strongest_and_last():
    echo = echoes_of([0, 0, 0, 0], [10.0], [DIFFUSE])
    assert echo[STRONGEST, [RANGE, STRENGTH, TRIANGLE, MIXED]] == pytest.approx([10.0, 1.0, 0, 0])
    assert (echo[LAST] == echo[STRONGEST]).all()
    assert not echo[SECOND].any()


def test_two_surfaces_nearer_than_0_6_m_give_one_echo_between_them():
    echo = echoes_of([0, 0, 1, 1], [10.0, 10.5], [DIFFUSE, DIFFUSE])
    assert echo[STRONGEST, [RANGE, STRENGTH, MIXED]] == pytest.approx([10.25, 1.0, 1])
    assert (echo[LAST] == echo[STRONGEST]).all()


def test_the_brighter_surface_draws_the_mixed_echo_towards_itself():
    echo = echoes_of([0, 0, 1, 1], [10.0, 10.5], [DIFFUSE, HALF])
    assert echo[STRONGEST, RANGE] == pytest.approx((10.0 * 0.5 + 10.5 * 0.25) / 0.75)


def test_two_surfaces_farther_apart_give_two_echoes():
    echo = echoes_of([0, 1, 1, 1], [10.0, 10.7], [DIFFUSE, DIFFUSE])
    assert echo[STRONGEST, [RANGE, STRENGTH]] == pytest.approx([10.7, 0.75])
    assert echo[LAST, RANGE] == pytest.approx(10.7)
    assert echo[SECOND, [RANGE, STRENGTH]] == pytest.approx([10.0, 0.25])


def test_the_last_of_three_need_not_be_strongest_nor_second():
    echo = echoes_of([0, 0, 0, 1, 1, 2], [10.0, 12.0, 14.0], [DIFFUSE] * 3)
    assert echo[[STRONGEST, SECOND, LAST], RANGE] == pytest.approx([10.0, 12.0, 14.0])


def test_strength_at_the_receiver_falls_with_the_square_of_the_range():
    echo = echoes_of([0, 1, 1], [10.0, 20.0], [DIFFUSE, DIFFUSE])
    # a third at 10 m outshines two thirds at 20 m
    assert echo[STRONGEST, RANGE] == pytest.approx(10.0)


def test_what_is_too_dark_is_not_seen():
    assert not echoes_of([0, 0], [10.0], [HALF], threshold=0.5 / 9.9**2).any()
    assert echoes_of([0, 0], [10.0], [HALF], threshold=0.5 / 10.1**2).any()


def test_light_goes_through_a_pane_and_back():
    echo = echoes_of([0, 0], [14.0, 10.0], [DIFFUSE, GLASS], clear=[1, 1])
    assert echo[STRONGEST, [RANGE, STRENGTH]] == pytest.approx([14.0, 0.81])
    assert echo[SECOND, [RANGE, STRENGTH]] == pytest.approx([10.0, 0.1])


def test_a_pane_behind_a_wall_is_not_seen():
    echo = echoes_of([0, 0], [8.0, 10.0], [DIFFUSE, GLASS], clear=[1, 1])
    assert echo[STRONGEST, STRENGTH] == pytest.approx(1.0)
    assert not echo[SECOND].any()


def test_rays_have_the_second_moment_of_a_uniform_disc():
    full_rad = 2.79e-3
    _, directions = aim(
        np.zeros((2, 3)),
        np.tile(np.eye(3), (2, 1, 1)),
        np.zeros(2),
        np.zeros(32),
        0.025,
        full_rad,
        0,
        np.ones((1, 32), np.bool_),
        RAYS,
    )
    off = directions.reshape(32, RAYS, 3).astype(np.float64)
    off = off - off[:, :1]
    # a disc of diameter d: mean square d^2 / 16 on each axis
    assert (off[..., [0, 2]] ** 2).mean(axis=1) == pytest.approx(full_rad**2 / 16, rel=1e-3)
    assert RING < 0.5


def test_azimuth_turns_clockwise_and_elevation_lifts():
    _, directions = aim(
        np.zeros((2, 3)),
        np.tile(np.eye(3), (2, 1, 1)),
        np.full(2, np.radians(90.0)),
        np.radians(np.linspace(-30, 10, 32)),
        0.025,
        0.0,
        0,
        np.ones((1, 32), np.bool_),
        1,
    )
    assert directions[:, 0] == pytest.approx(np.cos(np.radians(np.linspace(-30, 10, 32))), abs=1e-6)
    assert directions[:, 2] == pytest.approx(np.sin(np.radians(np.linspace(-30, 10, 32))), abs=1e-6)
    assert np.abs(directions[:, 1]).max() < 1e-6
