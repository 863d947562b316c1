# SPDX-License-Identifier: Apache-2.0
"""One module per subcommand of `dpm2`; `dpm2_core.cli` puts them together."""
