"""The signal controller: from what is known of the lanes to the phase that it requests.

`role` is the process, `policies` decide on an `observation`. `predictive` plans: `predictive_model`
has the tables of a signal, `predictive_traffic` what is learnt, `predictive_search` the search.
`queue_estimator` estimates lanes that no sensor covers, `config` is the scenario's part.
"""
