"""What shapes show: exact surfaces of spheres, disks and cylinders, and materials that are no BTFs."""
