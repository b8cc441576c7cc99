"""Steering nonholonomic systems with sinusoids (Murray and Sastry 1990): algebra, canonical systems, cars, trailers."""
