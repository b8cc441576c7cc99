"""Scripts that generate the assets vehsim ships. Run one after changing it and commit what it writes."""
