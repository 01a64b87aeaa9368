"""The edge's map of all agents: keyframes in, corrections out (docs/understand/mapping.md).

Begin with `mapper.Mapper`: `keyframe_lookup.KeyframeLookup.look_up` is a keyframe's way, `Mapper._solve_map`
that of a map that has changed:

    query_queue          which keyframe is looked up next
    revisits             which one of a waiting agent is looked up again
    candidates           which others it is compared with, and how
    recognition          align the images of keyframes nearby (`recognition.patch_alignment`); find others
                         (`recognition.index`), verify (`recognition.verification`) and align them
    agents               do the agents agree on scale and covariances? else quarantine
    loop_acceptance      is a loop accepted: alone, or with others (`loop_consistency`, `overlap_check`)
    map_graph            nodes, edges (`graph_edges`), and which segments (`segments`) form one map
    map_solving          the job of the solver (`graph`), and what its solution changes
    map_gauge            how that is published: without motions of the whole map that are uncertain
    localisation_gate    is an agent's place known well enough to publish a correction?
    corrections          which agents get one

`atlas.Atlas` holds all of it, each keyframe's pose in `pose_table`, who is present in `agent_runs`. Slow
work is yielded as `steps`, which the caller runs; what is decided and stored goes into `mapper_log`, as
`map_changes`. Keyframes leave by `culling` (`redundancy`), `forgetting`, and `map_renewal`
(`missing_points`); `keyframe_removal` mends the graph.

To change:

    the descriptor       `share.vision.orb`, `share.vision.matching`; size: `share.types.DESCRIPTOR_BYTES`;
                         `recognition.index` hashes its bits, `recognition.verification` bounds distances
    the verification     `recognition.verification`; `MIN_INLIERS`
    the loop's pose      `recognition.patch_alignment`, also its covariance
    accepting loops      `loop_acceptance`; `merge.join_places`
    the solver           `graph.optimiser` (Levenberg-Marquardt, robust kernel), `graph.solver` (incremental)
    the merge gate       `share.scheduling.merge_gate`
"""
