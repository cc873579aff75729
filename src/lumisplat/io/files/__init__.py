"""Helpers of all formats: errors of unreadable files, atomic writing, limits of memory."""
