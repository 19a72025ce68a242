"""Poses and boxes in the forms that the field uses: OPV2V, ETSI, ROS 2."""
