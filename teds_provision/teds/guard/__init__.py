"""The guard: refuses calibrations of the kinds that have hurt robots before."""
