"""The nonlinear program: variables, named parameters, sparse assembly, and the solver interface."""
