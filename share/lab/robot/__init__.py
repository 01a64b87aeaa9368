"""The closed loop: an emulated robot that drives by the shared map, in virtual time with real pixels.

    navigator -> cmd_vel -> drive -> true path -> camera and IMU -> tracker -> agent and edge -> bridge
        ^                                                                                           |
        +------------------------------ map → odom, goals ------------------------------------------+

Tracker, agent, edge, mapper and robot bridge are the product's; room, renderer and sensors the emulator's.
The robot, and a navigator as Nav2's, are modelled here.
"""
