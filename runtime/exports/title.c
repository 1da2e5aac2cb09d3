/* ${peer.name | comment} of ${peer.system.name | comment}, written by apc ${version}. {% for clock, period in periods %}${clock | comment} every ${period} s${", " if not loop.last else ""}{% endfor %}.
   Made from (SHA-256):{% for path, digest in peer.system.origin.digests %}
     ${digest | comment}  ${path | comment}{% endfor %} */
