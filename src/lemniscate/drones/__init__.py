"""Drones on crazyflow: the vehicle, the air around it, its classical controller."""
