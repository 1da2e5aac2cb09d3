/* ${peer.name | comment} of ${peer.model.name | comment}, written by apc ${version}. {% for clock, period in periods %}${clock | comment} every ${period} s${", " if not loop.last else ""}{% endfor %}.
   Made from (SHA-256):{% for path, digest in peer.model.origin.digests %}
     ${digest | comment}  ${path | comment}{% endfor %} */
