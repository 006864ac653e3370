"""Shots and poses to points in the world, and clouds as files."""
