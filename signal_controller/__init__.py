"""The signal controller: requests a phase from lane counts and tracked vehicles.

`role` is the process, `policies` decide on an `observation`. `predictive` is predictive control:
`predictive_model` has the tables of a signal, `predictive_traffic` what is learnt, `exits` which
exits have room, `predictive_search` the search. `queue_estimator` estimates lanes that no sensor
covers, `config` is the scenario's part.
"""
