"""Attitude and joint angles of linked segments."""
