"""Estimators of materials from photographs, side by side on sets whose truth is known."""
