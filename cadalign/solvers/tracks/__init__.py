"""Poses over time: smooth motion of one object, factorized in linear time."""
