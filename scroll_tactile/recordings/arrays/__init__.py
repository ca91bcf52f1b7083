"""Files of arrays, a row a reading: `.npy`, HDF5, Zarr and LeRobot data sets; reading them runs nothing of theirs."""
