"""The signal controller: from lane counts to the phase that it requests.

`role` is the process, `policies` decide, `queue_estimator` estimates lanes that no sensor covers,
`config` is the scenario's part.
"""
