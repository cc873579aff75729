"""Readers of body models (SMPL) and of motion (AMASS, BVH)."""
