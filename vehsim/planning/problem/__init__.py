"""The nonlinear programme: variables, named parameters, sparse assembly and the solver that is handed it."""
