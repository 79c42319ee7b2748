"""Figures: what a node reports of its results and of itself."""

import math

import numpy as np
import pytest

from beamsplat.common.messages import FusedDepth, MapStatus, Odometry
from beamsplat.common.runtime.figures import FIGURES, Figures


def values(figures):
    return {figure.name: figure.value for figure in figures.report()}


def odometry(**fields):
    return Odometry(stamp_ns=1, T_odom_body=np.eye(4), covariance=np.eye(3), **fields)


def test_results_set_their_figures_and_the_status():
    figures = Figures()
    assert figures.status == ""
    figures.note("localization/odometry", odometry(quality=0.75))
    assert (values(figures), figures.status) == ({"localization_quality_ratio": 0.75}, "ok")
    figures.note("localization/odometry", odometry(status="lost", detail="2 beams match"))
    assert (values(figures), figures.status) == ({}, "lost: 2 beams match"), "an old quality is no quality"
    figures = Figures()
    figures.note("mapping/status", MapStatus(stamp_ns=1, keyframes=3, gaussians=4000, steps=9, psnr_db=25.5))
    assert values(figures) == {
        "map_keyframes": 3.0, "map_refused_keyframes": 0.0, "map_gaussians": 4000.0, "map_steps_total": 9.0,
        "map_psnr_decibels": 25.5,
    }, "the depth error is not known"  # fmt: skip


def test_a_refused_depth_has_a_status_and_no_scale():
    none = np.zeros((0, 0), np.float32)
    figures = Figures()
    figures.note(
        "fusion/depth", FusedDepth.of(stamp_ns=1, depth_m=none, sigma_m=none, status="too few beams")
    )
    assert figures.status == "too few beams"
    assert values(figures) == {"depth_inliers_ratio": 0.0}


def test_names_are_checked_and_unknown_values_are_removed():
    figures = Figures()
    with pytest.raises(KeyError, match="no figure is called 'link_upp'; there are disk_free_bytes"):
        figures.set("link_upp", 1)
    for nothing in (None, math.nan, math.inf):
        figures.set("link_up", True)
        assert values(figures) == {"link_up": 1.0}
        figures.set("link_up", nothing)
        assert values(figures) == {}


def test_names_follow_the_rules_of_prometheus():
    for name, kind in FIGURES.items():
        assert kind.counter == name.endswith("_total"), name
        assert name.isascii()
        assert name == name.lower()
