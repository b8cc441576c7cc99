"""Vehicles and terrains that ship with vehsim, and the scripts that generate them."""
