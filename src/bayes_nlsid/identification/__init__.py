"""The residual of Eq. 13, its bounds, the fit, and forward-backward selection."""
