"""The arm: chain, inverse kinematics, bodies and the free paths between configurations."""
