"""Point clouds: the type, preprocessing, voxels, maps, colour spaces."""
