"""The simulated world: traffic in SUMO, the signal cabinet, the clock of the frames, ground truth.

`role` runs frame after frame; `world` is the traffic, `journeys` the vehicles in it, `cabinet` what
the signal shows; `presence` tracks which processes are present. Before a run, `setup` collects what
every process receives: `netfile` and `road_map` read the net, `demand` its vehicles and flows,
`junctions` makes nets with the tools of `sumo`. `config` is the scenario's part, `limits` bounds on
received data.
"""
