"""Agent and edge as state machines: events in, effects out; `agent.AgentProtocol.handle`,
`edge.EdgeProtocol.handle`.

`share.runtime.agent` and `share.runtime.served_room` carry the effects out;
`share.lab.evaluate.simulation` runs the same machines in virtual time. An agent:

    agent_events         its events and effects (those of all machines: `common_events`)
    edge_connection      hello, welcome, refusal, silence of the edge (`versions`)
    edge_clock           the edge's clock, by ping and pong
    agent_ledger         keyframes: ids and relative poses; which are sent, acknowledged, due again
    keyframe_pace        which keyframe candidates are sent, by the edge's rate and window
    localisation         T_map_odom without visible steps, and the expected error
    correction_delay     the delay of corrections
    agent_status         its state, as it reports it
    streaming            an agent whose frames the edge tracks (the edge's side: `remote_tracking`)

The edge:

    edge_events          its events and effects
    edge_membership      which runs are in the room (`admission`)
    peer                 one run at the edge (`agent_health`)
    keyframe_intake      order, quota and plausibility of keyframes on their way to the mapper
    edge_records         what it sends, stores and logs
    client_service       its clients (`client_registry`): their objects (`object_service`, `room_objects`) and
                         commands (`command_service`), in maps that join (`known_maps`)

A client: `room_client` (`room_events`, `object_replica`).
"""
