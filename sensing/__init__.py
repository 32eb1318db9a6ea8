"""Simulated LiDARs of agents, and the upload of their scans.

Scene:    `terrain`, `road`, `mesh`, `scene` build the static world; `embree` casts rays into it,
          `candidates` at vehicles; `lidar` makes scans of the hits.
Sources:  `source` chooses where scans come from: `lidar`, a CARLA server (`carla`) or
          `recorded_scans`. `point_files`, `pcd`, `ply`, `feather` read point clouds in common file
          formats.
Uploads:  `upload_policies` lists the policies; `upload_filters` and `upload_selection` choose
          beams and chunks; `uplink` and `lidar_uplink` encode and send them.
Links:    `link_profile` and `link_config` describe a link, `link_channel` computes its rate and
          delay, `packet_loss` its packet loss; `tcp_sender` and `congestion_control` repair that,
          `lossy_link` in simulated time. `radio` is one agent's side of a link, `link_budget` warns
          of one that a scan does not fit through.
Agents:   `station` is what all agent processes share, `pose` an agent's estimate of its pose.
          `config` is the scenario's part, `limits` what files and messages may hold, `noise`
          gives the random streams.
"""
