"""Models, data sets, devices and browsers that several tests share."""
