"""A world with known truth: what it sends is judged against the sensors' manuals and recordings, never against our decoder.

Conventions beside those of `flightlog`
---------------------------------------
Time
    `time_s` is true time in seconds since the simulation starts; `clocks` turns it into what each device believes.
World
    The local frame of `flightlog` (x east, y north, z up); its origin is stated in truth.json. Surfaces are triangles.
Chance
    Every source of noise draws from `chance.generator(seed, its own name, chunk)`, so that a result depends on neither the number
    of workers nor on which other noise is switched on.

Map
---
config, chance, clocks, geodesy            options; random streams; what each clock shows; local frame to latitude and longitude
plans, flights/                            named flights: scene, route, duration and errors in one file each
materials, meshes, parts, buildings        reflectances at 905 nm; shapes as triangles; houses
scene, ground, town, lake                  the named scenes
route, flight                              where to fly; position, attitude and rates at any time
rays, echoes, lidar, telemetry             beams against triangles; echoes of a beam; data packets; position packets
moving, boxes                              cars and people, on ways of their own; beams that meet them
imu, ins, autopilot                        constant errors of inertial sensors; what the INS believes; what it says over MAVLink
boardlog                                   what it writes on its own card
faults, capture, truth                     what goes wrong; pcap and tlog; truth files
simulation, recording, render              all of one job; its files while they are written; from start to end
cameras, photographs, rigfile, checkpoints what a camera is; its images; rig.yaml; surveyed points and panels
outdoors, powerline                        clouds with known truth, without a flight
play, command                              live to UDP and a pty; `swath simulate`
"""
